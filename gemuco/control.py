"""Control (paper, II-I): the command whose predicted outcome loses least."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gemuco.descent import DescentConfig, NewtonConfig
from gemuco.errors import NotFinite, NotObservable, SchemaError
from gemuco.losses import Hold, Match, StayNear, Term
from gemuco.masks import Mask, label
from gemuco.routes import Limits, bounds_of, checked_mask, checked_route
from gemuco.schema import BodySchema
from gemuco.search import Search

SEARCH = NewtonConfig()


@dataclass(frozen=True, slots=True)
class Solution:
    """What to do, and what is expected of it.

    Attributes:
        command: The commanded signal [its unit], shape (n,), inside its limits.
        predicted: Signal -> its value when the command has been followed [its unit], shape (n,).
        loss: Sum of the terms.
        residual: How far the body that the command leads to, asked of the network again, is from what was to be matched
            (root mean square, standard deviations); NaN if no mask can tell.
        route: `mask` (usages a and b), `latent` (e) or `input` (f).
        mask: The signals that the network was given; empty for `latent`.
        is_late: Whether time was up before the search ended; the command is the best that it had found.
    """

    command: np.ndarray
    predicted: dict[str, np.ndarray]
    loss: float
    residual: float
    route: str
    mask: Mask
    is_late: bool = False


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
        schema.layout.slice(self.command)
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
        self.schema = schema

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
        schema = self.schema
        terms = self._terms(target)
        present = schema.normalise_one(now or {})
        wishes = [term for term in terms if not isinstance(term, Hold)]
        holds = [term for term in terms if isinstance(term, Hold)]
        held = merged(schema, [hold.wanted(schema, target) for hold in holds])
        direct = held.copy()
        for wish in wishes:
            if isinstance(wish, Match) and wish.matrix is None and wish.signal != self.command:
                direct = np.where(np.isfinite(direct), direct, schema.normalise({wish.signal: wish.reference(target)}))
        route, mask = self._choose(wishes, schema.layout.whole(np.isfinite(direct)))
        bounds = [wish.bind(schema, target, now or {}) for wish in wishes]
        needed = {name for wish in wishes for name in wish.signals} | {hold.signal for hold in holds}
        near = [
            schema.normalise({wish.signal: wish.reference(schema, target, now or {})})
            for wish in wishes
            if isinstance(wish, StayNear)
        ]
        begin = merged(schema, [present, *near])
        found = self._search.find(schema, route, mask, bounds, direct, held, sorted(needed), begin, bool(near), within)
        x = self._limited(found.x)
        values = schema.scaler.restore(x)
        predicted = {name: part for name, part in schema.layout.split(values).items() if np.isfinite(part).all()}
        return Solution(
            predicted[self.command].copy(),
            predicted,
            found.loss,
            self._residual(x, wishes, target),
            route,
            mask,
            found.is_late,
        )

    def _terms(self, target: Mapping[str, np.ndarray]) -> tuple[Term | Hold, ...]:
        """The terms, after a look at whether they and the target are about the same signals."""
        for name in target:
            self.schema.layout.slice(name)
        if not target and not self.terms:
            raise NotObservable("Nothing was asked: give a target, or terms with values of their own.")
        terms = tuple(Match(name) for name in target) if self.terms is None else self.terms
        minded = {name for term in terms for name in signals_of(term)}
        minded |= {name for term in terms if (name := getattr(term, "position", "")) in target}
        for name in target:
            if name not in minded:
                known = ", ".join(sorted(minded)) or "nothing"
                raise NotObservable(f"A target of '{name}' was given, but no term is about it; they are about {known}.")
        for term in terms:
            if isinstance(term, Match) and not np.isfinite(term.reference(target)).all():
                raise NotFinite(f"The target of '{term.signal}' is not finite; every element needs a number.")
        return terms

    def _choose(self, wishes: Sequence[Term], direct: Mask) -> tuple[str, Mask]:
        """Route and mask for what is asked; `direct` are the signals whose whole value was decided by the asker."""
        schema = self.schema
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

    def _limited(self, x: np.ndarray) -> np.ndarray:
        if self.command not in self.limits:
            return x
        span, scaler = self.schema.layout.slice(self.command), self.schema.scaler
        low, high = (np.asarray(b, float) for b in self.limits[self.command])
        x = x.copy()
        x[span] = (np.clip(x[span] * scaler.std[span] + scaler.mean[span], low, high) - scaler.mean[span]) / (
            scaler.std[span]
        )
        return x

    def _residual(self, x: np.ndarray, wishes: Sequence[Term], target: Mapping[str, np.ndarray]) -> float:
        """What was to be matched, asked of the network again, from the command and as little else as possible."""
        schema = self.schema
        matches = [wish for wish in wishes if isinstance(wish, Match) and wish.signal in schema.x_out]
        judged = {wish.signal for wish in matches} - {self.command}
        there = schema.layout.whole(np.isfinite(x))
        blind = [m for m in schema.masks if self.command in m and m <= there and not m & judged]
        if not blind or not judged:
            return float("nan")
        again = np.zeros(schema.layout.size)
        again[schema.out_index] = schema.infer(x, min(blind, key=len))
        amiss = [
            replace(wish, unit="std").difference(schema, target).at(again[None])[0]
            for wish in matches
            if wish.signal in judged
        ]
        return float(np.sqrt(np.mean(np.concatenate(amiss) ** 2)))


def signals_of(term: Term | Hold) -> tuple[str, ...]:
    """The signals that a term is about."""
    return (term.signal,) if isinstance(term, Hold) else term.signals


def merged(schema: BodySchema, parts: Sequence[np.ndarray]) -> np.ndarray:
    """What several holds hold together, shape (size,) [standard deviations]; NaN where free."""
    merged = np.full(schema.layout.size, np.nan)
    for part in parts:
        merged = np.where(np.isfinite(part), part, merged)
    return merged
