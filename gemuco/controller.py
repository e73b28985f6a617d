"""Control (paper, II-I): the command whose predicted outcome loses least."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from gemuco.errors import NotFinite, NotObservable, SchemaError, check_kind
from gemuco.masks import Mask, label
from gemuco.schema import BodySchema, check_schema
from gemuco.search.asked import Asked, check_present, merged, signals_of
from gemuco.search.descent import DescentConfig, NewtonConfig
from gemuco.search.losses import Hold, Match, StayNear, Term
from gemuco.search.routes import Limits, bounds_of, checked_mask, checked_route
from gemuco.search.search import Found, Search

SEARCH = NewtonConfig()


@dataclass(frozen=True, eq=False)
class Solution:
    """What to do, and what is expected of it; the latter is computed when it is looked at.

    Attributes:
        command: The commanded signal [its unit], shape (n,), inside its limits.
        loss: Sum of the terms.
        route: `mask` (usages a and b), `latent` (e) or `input` (f).
        mask: The signals that the network was given; empty for `latent`.
        is_late: Whether time was up before the search ended; the command is the best that it had found.
        predicted: Signal -> its value when the command has been followed [its unit], shape (n,).
        residual: How far the body that the command leads to, asked of the network again, is from what was to be matched
            (root mean square, standard deviations); NaN if no mask can tell.
    """

    command: np.ndarray
    loss: float
    route: str
    mask: Mask
    is_late: bool
    _outlook: "Outlook" = field(repr=False)

    @cached_property
    def predicted(self) -> dict[str, np.ndarray]:
        """Signal -> its value when the command has been followed [its unit], shape (n,)."""
        values = self._outlook.schema.scaler.restore(self._outlook.x)
        parts = self._outlook.schema.layout.split(values)
        found = {name: part for name, part in parts.items() if np.isfinite(part).all()}
        return found | {self._outlook.command: self.command.copy()}

    @cached_property
    def residual(self) -> float:
        """See the class."""
        return self._outlook.residual()


@dataclass(frozen=True, slots=True)
class Outlook:
    """Where a search for a command ended.

    Attributes:
        schema: Whose predictions.
        command: The signal that is commanded.
        x: What is predicted, shape (size,) [standard deviations]; NaN for what the route says nothing about.
        wishes: What was to be matched.
        target: Signal -> reference [its unit], shape (n,).
    """

    schema: BodySchema
    command: str
    x: np.ndarray
    wishes: Sequence[Match]
    target: Mapping[str, np.ndarray]

    def residual(self) -> float:
        """What was to be matched, asked of the network again, from the command and as little else as possible."""
        schema, x = self.schema, self.x
        matches = [wish for wish in self.wishes if wish.signal in schema.x_out]
        judged = {wish.signal for wish in matches} - {self.command}
        there = schema.layout.whole(np.isfinite(x))
        blind = [m for m in schema.masks if self.command in m and m <= there and not m & judged]
        if not blind or not judged:
            return float("nan")
        again = np.zeros(schema.layout.size)
        again[schema.out_index] = schema.infer(x, min(blind, key=len))
        amiss = [
            replace(wish, unit="std").difference(schema, self.target).at(again[None])[0]
            for wish in matches
            if wish.signal in judged
        ]
        return float(np.sqrt(np.mean(np.concatenate(amiss) ** 2)))


class Controller:
    """Finds commands for targets, each solve beginning where the last one ended.

    Route `auto` is the paper's rule. `mask`, usages (a) and (b): the command is in x_out, and a feasible mask is
    exactly what is asked. `latent`, usage (e): the command is in x_out, and what is asked needs a loss; z descends.
    `input`, usage (f): the command is not in x_out; the command itself descends as part of x_in.

    A robot may know better and name route and mask:

    - Descent on z can end beside the data's manifold, where the predicted target fits but the predicted command does
      not lead there (see `Solution.residual`). With route `input` the command itself descends, as if it were not in
      x_out, under the smallest mask that holds it, and what is predicted is what it leads to.
    - With route `input` and a mask that leaves out the command, as (theta, f) does for l, the target is given to the
      network as if it were measured, and descent runs over the rest of the mask.
    """

    def __init__(
        self,
        schema: BodySchema,
        terms: Sequence[Term | Hold] | None,
        command: str,
        route: str = "auto",
        search: DescentConfig | NewtonConfig | None = None,
        mask: Mask | None = None,
        limits: Limits | None = None,
    ) -> None:
        """Prepare for commands of one signal.

        Args:
            schema: The body schema.
            terms: What is asked; to match every target if not given.
            command: The signal that is commanded.
            route: `auto`, `mask`, `latent` or `input`.
            search: How to descend.
            mask: Signals that the network is given; chosen from the route if not given.
            limits: Signal -> bounds of what may be tried; a command that the network infers is clipped to them.

        Raises:
            SchemaError: The route is not known, or terms or limits make no sense.
            UnknownSignal: The command is not in the layout.
            NotObservable: The schema can neither infer the command nor try it, or the mask is not feasible.
        """
        self.terms = None if terms is None else tuple(terms)
        self.command, self.route, self.mask = command, checked_route(route), mask
        self.limits = dict(limits or {})
        self._search = Search(search or SEARCH, self.limits)
        if mask is not None and route in ("latent", "auto"):
            raise SchemaError(f"A mask goes with route mask or input, not with '{route}'.")
        self.swap(schema)

    def swap(self, schema: BodySchema) -> None:
        """Go on with another schema of the same body; the warm start is kept."""
        check_schema(schema)
        check_kind("The command", self.command, str, "the name of a signal")
        span = schema.layout.slice(self.command)
        if self.command not in (*schema.x_in, *schema.x_out):
            raise NotObservable(
                f"'{self.command}' is commanded, but this schema neither infers nor takes it; it takes "
                f"{', '.join(schema.x_in)} and infers {', '.join(schema.x_out)}."
            )
        if self.mask is not None:
            checked_mask(schema, self.mask)
        bounds_of(schema, self.limits)
        for term in self.terms or ():
            for name in signals_of(term):
                schema.layout.slice(name)
        self.schema, self._span = schema, span
        self._mean, self._std = schema.scaler.mean[span], schema.scaler.std[span]
        self._names: tuple[str, ...] | None = None
        self._search.drop()

    def restart(self) -> None:
        """Forget the warm start."""
        self._search.restart()

    def solve(
        self,
        target: Mapping[str, np.ndarray],
        now: Mapping[str, np.ndarray] | None = None,
        within: float = math.inf,
    ) -> Solution:
        """The command for a target.

        Args:
            target: Signal -> reference [its unit], shape (n,): what `Match` reaches, `Hold` holds and `StayNear` stays
                near; a search that shall stay near something begins there, others begin from the present and from
                training data.
            now: Signal -> present value [its unit], shape (n,); NaN or absent where it is not known.
            within: Time that a second-order search may take [s]; the best found until then is the solution.

        Raises:
            UnknownSignal: A name is not in the layout.
            WrongSize: An array does not have its signal's size.
            NotFinite: A target is NaN or infinite.
            NotObservable: A term or the route cannot work with this schema.
        """
        schema, now = self.schema, {} if now is None else now
        check_kind("The target", target, Mapping, "a mapping of signal -> reference")
        if tuple(target) != self._names:
            self._ask(target)
        check_present(schema, now)
        for wish in self._matches:
            if not np.isfinite(wish.reference(target)).all():
                raise NotFinite(f"The target of '{wish.signal}' is not finite; every element needs a number.")
        self._asked.read(target, now)
        direct = self._direct(target)
        near = [wish for wish in self._asked.wishes if isinstance(wish, StayNear)]

        def begin() -> np.ndarray:
            to = [schema.normalise({wish.signal: wish.reference(schema, target, now)}) for wish in near]
            return merged(schema, [schema.normalise_one(now), *to])

        return self._solution(self._search.find(self._asked, direct, self._choose, begin, bool(near), within), target)

    def _ask(self, target: Mapping[str, np.ndarray]) -> None:
        """Lay the terms out, after a look at whether they and the target are about the same signals."""
        schema = self.schema
        for name in target:
            schema.layout.slice(name)
        if not target and not self.terms:
            raise NotObservable("Nothing was asked: give a target, or terms with values of their own.")
        terms = tuple(Match(name) for name in target) if self.terms is None else self.terms
        minded = {name for term in terms for name in signals_of(term)}
        minded |= {name for term in terms if (name := getattr(term, "position", "")) in target}
        for name in target:
            if name not in minded:
                known = ", ".join(sorted(minded)) or "nothing"
                raise NotObservable(f"A target of '{name}' was given, but no term is about it; they are about {known}.")
        if self._names is None or self.terms is None:
            self._asked = Asked(schema, terms)
            self._matches = [wish for wish in self._asked.wishes if isinstance(wish, Match)]
        self._names = tuple(target)

    def _direct(self, target: Mapping[str, np.ndarray]) -> np.ndarray:
        """What the asker decided, shape (size,) [standard deviations]: what is held, and what is plainly matched."""
        direct, layout, scaler = self._asked.held.copy(), self.schema.layout, self.schema.scaler
        for wish in self._matches:
            if wish.matrix is None and wish.signal != self.command:
                span = layout.slices[wish.signal]
                value = (wish.reference(target) - scaler.mean[span]) / scaler.std[span]
                np.copyto(direct[span], value, where=np.isnan(direct[span]))
        return direct

    def _solution(self, found: Found, target: Mapping[str, np.ndarray]) -> Solution:
        x, span = found.x, self._span
        command = x[span] * self._std + self._mean
        if self.command in self.limits:
            command = np.clip(command, *self.limits[self.command])
            x[span] = (command - self._mean) / self._std
        kept = {name: np.array(value, float) for name, value in target.items()}
        outlook = Outlook(self.schema, self.command, x, self._matches, kept)
        return Solution(command, found.loss, found.route, found.mask, found.is_late, outlook)

    def _choose(self, direct: Mask) -> tuple[str, Mask]:
        """Route and mask for what is asked; `direct` are the signals whose whole value was decided by the asker."""
        schema, wishes = self.schema, self._asked.wishes
        asked = {wish.signals[0] for wish in wishes if isinstance(wish, Match)}
        infers = self.command in schema.x_out
        if self.mask is not None:
            if self.command not in self.mask and not infers:
                raise NotObservable(f"'{self.command}' is neither in the mask nor inferred; the mask must hold it.")
            if self.route == "mask" and not self.mask <= direct:
                missing = label(self.mask - direct, schema.layout.names)
                raise NotObservable(f"Route mask needs a target of {missing}; give one, or use route input.")
            return self.route, self.mask
        plain = all(isinstance(wish, Match) and wish.matrix is None for wish in wishes)
        if self.route == "mask" or (self.route == "auto" and infers and plain and direct in schema.masks):
            if not (infers and plain and direct in schema.masks):
                raise NotObservable(
                    f"Route mask needs '{self.command}' in x_out, plain targets only, and a feasible mask of exactly "
                    f"{label(direct, schema.layout.names) or 'nothing'}; use route latent or input."
                )
            return "mask", direct
        if self.route == "latent" or (self.route == "auto" and infers):
            self._check_latent(wishes)
            return "latent", frozenset()
        trying = [m for m in schema.masks if self.command in m]
        giving = [m for m in schema.masks if infers and asked and asked <= (m & direct) and self.command not in m]
        if not trying and not giving:
            raise NotObservable(
                f"No feasible mask holds '{self.command}', nor all of {', '.join(sorted(asked)) or 'what is asked'} "
                f"without it; use route latent."
            )
        return "input", min(trying, key=lambda m: (len(m & asked), len(m))) if trying else max(giving, key=len)

    def _check_latent(self, wishes: Sequence[Term]) -> None:
        if self.command not in self.schema.x_out:
            raise NotObservable(f"Route latent decodes the command, but '{self.command}' is not in x_out; use input.")
        for wish in wishes:
            for name in wish.signals:
                if name not in self.schema.x_out:
                    raise NotObservable(
                        f"Route latent predicts only x_out ({', '.join(self.schema.x_out)}), but a term is about "
                        f"'{name}'; use route input."
                    )


def control(
    schema: BodySchema,
    target: Mapping[str, np.ndarray],
    now: Mapping[str, np.ndarray] | None = None,
    *,
    command: str,
    terms: Sequence[Term | Hold] | None = None,
    **options: Any,
) -> Solution:
    """Find the command that brings about a target, from scratch; `Controller` goes on from its last solve.

    Args:
        schema: The body schema.
        target: Signal -> reference [its unit].
        now: Signal -> present value [its unit].
        command: The signal that is commanded.
        terms: What is asked; to match every target if not given.
        options: Of `Controller`: route, mask, search, limits.
    """
    return Controller(schema, terms, command, **options).solve(target, now)
