"""Control (paper, II-I): the command whose predicted outcome has the least loss."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from gemuco.errors import NotFinite, NotObservable, check_kind
from gemuco.masks import Mask, label
from gemuco.schema import BodySchema
from gemuco.search.descent import DescentConfig, NewtonConfig
from gemuco.search.losses import Hold, Match, StayNear, Term
from gemuco.search.request import Request, checked_terms, merged, signals_of
from gemuco.search.routes import Limits, check_command
from gemuco.search.search import Outcome, Search


@dataclass(frozen=True, eq=False)
class Solution:
    """A command and its predicted outcome. `predicted` and `residual` are computed at their first use.

    Attributes:
        command: The commanded signal [its unit], shape (n,), inside its limits.
        loss: Sum of the terms.
        route: `mask` (usages a and b), `latent` (e) or `input` (f).
        mask: Signals given to the network; empty for `latent`.
        is_late: Whether the deadline ended the search; the command is then the best one found.
        predicted: Signal -> its value after the command [its unit], shape (n,).
        residual: Root mean square error of the targets when the network predicts them from the command [standard
            deviations]; NaN if no mask allows this prediction.
    """

    command: np.ndarray
    loss: float
    route: str
    mask: Mask
    is_late: bool
    _outcome: "_CommandOutcome" = field(repr=False)

    @cached_property
    def predicted(self) -> dict[str, np.ndarray]:
        """Signal -> its value after the command [its unit], shape (n,)."""
        schema = self._outcome.schema
        values = schema.layout.split(schema.scaler.restore(self._outcome.x))
        predicted = {name: value for name, value in values.items() if np.isfinite(value).all()}
        return predicted | {self._outcome.command: self.command.copy()}

    @cached_property
    def residual(self) -> float:
        """Error of the targets when the network predicts them from the command [standard deviations]."""
        return self._outcome.residual()


@dataclass(frozen=True, slots=True)
class _CommandOutcome:
    """Predicted outcome of a command.

    Attributes:
        schema: The schema that predicts.
        command: The signal that is commanded.
        x: Prediction, shape (size,) [standard deviations]; NaN outside of the route.
        matches: The terms that match a target.
        target: Signal -> reference [its unit], shape (n,).
    """

    schema: BodySchema
    command: str
    x: np.ndarray
    matches: Sequence[Match]
    target: Mapping[str, np.ndarray]

    def residual(self) -> float:
        """Return the error of the targets, predicted under the smallest mask with the command and without targets."""
        schema, x = self.schema, self.x
        matches = [match for match in self.matches if match.signal in schema.x_out]
        signals = {match.signal for match in matches} - {self.command}
        available = schema.layout.whole(np.isfinite(x))
        masks = [m for m in schema.masks if self.command in m and m <= available and not m & signals]
        if not masks or not signals:
            return float("nan")
        prediction = np.zeros(schema.layout.size)
        prediction[schema.out_index] = schema.infer(x, min(masks, key=len))
        errors = [
            replace(match, unit="std").difference(schema, self.target).at(prediction[None])[0]
            for match in matches
            if match.signal in signals
        ]
        return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


class Controller:
    """A solver that finds commands for targets. Each search starts from the previous solution.

    Route `auto` selects a route by the paper's rule:

    - `mask`, usages (a) and (b): the command is in x_out, and the targets are exactly a feasible mask.
    - `latent`, usage (e): the command is in x_out, and the terms need a loss; z is searched.
    - `input`, usage (f): the command is not in x_out; the command itself is searched as part of x_in.

    Route and mask can also be specified:

    - A search of z can end outside the manifold of the data: the predicted target fits, but the predicted command does
      not lead to it (see `Solution.residual`). With route `input` the command itself is searched, as if it were not in
      x_out, under the smallest mask that contains it. The prediction is then the outcome of the command.
    - With route `input` and a mask without the command, such as (theta, f) for the command l, the target is given to
      the network as if it were measured, and the rest of the mask is searched.
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
        """Prepare the search for commands of one signal.

        Args:
            schema: The body schema.
            terms: The terms of the loss; a `Match` of every target if not given.
            command: The signal that is commanded.
            route: `auto`, `mask`, `latent` or `input`.
            search: Settings of the search.
            mask: Signals given to the network; chosen for the route if not given.
            limits: Signal -> bounds of the search; a command that the network infers is clipped to them.

        Raises:
            SchemaError: The route is not known, or terms or limits are contradictory.
            UnknownSignal: The command is not in the layout.
            NotObservable: The command is neither input nor output of the network, or the mask is not feasible.
        """
        self.terms, self.command, self.route, self.mask = terms, command, route, mask
        self.limits = dict(limits or {})
        self._search = Search(search, self.limits)
        self.swap(schema)

    def swap(self, schema: BodySchema) -> None:
        """Use another schema of the same body from now on; the warm start is kept."""
        check_command(schema, self.command, self.route, self.mask, self.limits)
        self.terms = None if self.terms is None else checked_terms(schema, self.terms)
        self.schema, self._span = schema, schema.layout.slice(self.command)
        self._mean, self._std = schema.scaler.mean[self._span], schema.scaler.std[self._span]
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
        """Find the command for a target.

        Args:
            target: Signal -> reference [its unit], shape (n,), of `Match`, `Hold` and `StayNear`. A search with
                `StayNear` starts at its reference; other searches start at the present values and training data.
            now: Signal -> present value [its unit], shape (n,); NaN or absent if unknown.
            within: Time limit of a second-order search [s]; the solution is then the best point found.

        Raises:
            UnknownSignal: A name is not in the layout.
            WrongSize: An array does not have its signal's size.
            NotFinite: A target is NaN or infinite.
            NotObservable: A term or the route cannot work with this schema.
        """
        schema, now = self.schema, {} if now is None else now
        check_kind("The target", target, Mapping, "a mapping of signal -> reference")
        if tuple(target) != self._names:
            self._make_request(target)
        schema.layout.join_one(now)
        for match in self._matches:
            if not np.isfinite(match.reference(target)).all():
                raise NotFinite(f"The target of '{match.signal}' is not finite; every element needs a number.")
        self._request.read(target, now)
        near = [term for term in self._request.terms if isinstance(term, StayNear)]

        def start() -> np.ndarray:
            postures = [schema.normalise({term.signal: term.reference(schema, target, now)}) for term in near]
            return merged(schema, [schema.normalise_one(now), *postures])

        inputs = self._inputs(target)
        outcome = self._search.find(self._request, inputs, self._choose, start, bool(near), within)
        return self._solution(outcome, target)

    def _make_request(self, target: Mapping[str, np.ndarray]) -> None:
        """Make the request after a check that every target belongs to a term."""
        schema = self.schema
        for name in target:
            schema.layout.slice(name)
        if not target and not self.terms:
            raise NotObservable("There is nothing to reach: give a target, or terms with values of their own.")
        terms = tuple(Match(name) for name in target) if self.terms is None else self.terms
        used = {name for term in terms for name in signals_of(term)}
        used |= {name for term in terms if (name := getattr(term, "position", "")) in target}
        for name in target:
            if name not in used:
                signals = ", ".join(sorted(used)) or "none"
                raise NotObservable(f"The target '{name}' is in no term. Signals of the terms: {signals}.")
        if self._names is None or self.terms is None:
            self._request = Request(schema, terms)
            self._matches = [term for term in self._request.terms if isinstance(term, Match)]
        self._names = tuple(target)

    def _inputs(self, target: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the fixed inputs: held elements, and targets matched without a matrix.

        Returns:
            Values [standard deviations], shape (size,); NaN elsewhere.
        """
        inputs, layout, scaler = self._request.held.copy(), self.schema.layout, self.schema.scaler
        for match in self._matches:
            if match.matrix is None and match.signal != self.command:
                span = layout.slices[match.signal]
                value = (match.reference(target) - scaler.mean[span]) / scaler.std[span]
                np.copyto(inputs[span], value, where=np.isnan(inputs[span]))
        return inputs

    def _solution(self, outcome: Outcome, target: Mapping[str, np.ndarray]) -> Solution:
        x, span = outcome.x, self._span
        command = x[span] * self._std + self._mean
        if self.command in self.limits:
            command = np.clip(command, *self.limits[self.command])
            x[span] = (command - self._mean) / self._std
        references = {name: np.array(value, float) for name, value in target.items()}
        predicted = _CommandOutcome(self.schema, self.command, x, self._matches, references)
        return Solution(command, outcome.loss, outcome.route, outcome.mask, outcome.is_late, predicted)

    def _choose(self, inputs: Mask) -> tuple[str, Mask]:
        """Choose route and mask from the signals whose elements are all fixed by targets and holds."""
        schema, terms = self.schema, self._request.terms
        matched = {term.signals[0] for term in terms if isinstance(term, Match)}
        infers = self.command in schema.x_out
        if self.mask is not None:
            if self.command not in self.mask and not infers:
                raise NotObservable(f"'{self.command}' is neither in the mask nor inferred; the mask must contain it.")
            if self.route == "mask" and not self.mask <= inputs:
                missing = label(self.mask - inputs, schema.layout.names)
                raise NotObservable(f"Route mask needs a target of {missing}; give one, or use route input.")
            return self.route, self.mask
        is_plain = all(isinstance(term, Match) and term.matrix is None for term in terms)
        is_by_mask = infers and is_plain and inputs in schema.masks
        if self.route == "mask" or (self.route == "auto" and is_by_mask):
            if not is_by_mask:
                raise NotObservable(
                    f"Route mask needs '{self.command}' in x_out, targets without a matrix and no other terms, and "
                    f"a feasible mask of exactly {label(inputs, schema.layout.names) or 'nothing'}; use route latent "
                    "or input."
                )
            return "mask", inputs
        if self.route == "latent" or (self.route == "auto" and infers):
            self._check_latent(terms)
            return "latent", frozenset()
        with_command = [m for m in schema.masks if self.command in m]
        with_targets = [m for m in schema.masks if infers and matched and matched <= m & inputs]
        if not with_command and not with_targets:
            raise NotObservable(
                f"No feasible mask contains '{self.command}', nor all of {', '.join(sorted(matched)) or 'the targets'} "
                f"without it; use route latent."
            )
        if with_command:
            return "input", min(with_command, key=lambda m: (len(m & matched), len(m)))
        return "input", max(with_targets, key=len)

    def _check_latent(self, terms: Sequence[Term]) -> None:
        if self.command not in self.schema.x_out:
            raise NotObservable(f"Route latent decodes the command, but '{self.command}' is not in x_out; use input.")
        for term in terms:
            for name in term.signals:
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
    """Find the command for a target by one independent search; a `Controller` starts from its previous solution.

    Args:
        schema: The body schema.
        target: Signal -> reference [its unit].
        now: Signal -> present value [its unit].
        command: The signal that is commanded.
        terms: The terms of the loss; a `Match` of every target if not given.
        options: Further arguments of `Controller`: route, mask, search, limits.
    """
    return Controller(schema, terms, command, **options).solve(target, now)
