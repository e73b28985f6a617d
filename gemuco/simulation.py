"""Simulation (paper, II-J): the state of the body that a command and constraints bring about, step after step."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gemuco.errors import NotFinite, NotObservable
from gemuco.masks import Mask, best, label
from gemuco.schema import BodySchema
from gemuco.search.descent import DescentConfig, NewtonConfig
from gemuco.search.losses import Hold, Match, Term
from gemuco.search.request import Request, checked_terms
from gemuco.search.routes import Limits, check_command
from gemuco.search.search import Search


@dataclass(frozen=True, slots=True)
class SimulatedState:
    """State of the body after a command.

    Attributes:
        values: Signal -> value [its unit], shape (n,); of the command the value reached.
        loss: Sum of the terms.
        residual: Root mean square over x_out of the state minus the network's prediction from it [standard deviations],
            large for a state beside the manifold of the data and a command that is not reached; NaN without a mask.
        route: `mask` (usages a and b), `latent` (e) or `input` (f).
        mask: The signals given to the network; empty for `latent`.
    """

    values: dict[str, np.ndarray]
    loss: float
    residual: float
    route: str
    mask: Mask


class Simulator:
    """A simulation from state to state; each search begins at the end of the last one.

    Route `auto` is the paper's rule, that of estimation. `mask`: there are no terms, and commanded and held signals
    cover a feasible mask; `latent`: z is searched for terms about x_out; `input`: some x_in are searched.

    With route `input` a mask can be named. The command is given to the network if it is in the mask, and else inferred
    and matched, as l is under (theta, f): every state is then consistent for the network.
    """

    def __init__(
        self,
        schema: BodySchema,
        terms: Sequence[Term | Hold],
        command: str,
        route: str = "auto",
        search: DescentConfig | NewtonConfig | None = None,
        mask: Mask | None = None,
        limits: Limits | None = None,
    ) -> None:
        """Prepare to simulate commands of one signal.

        Args:
            schema: The body schema.
            terms: Constraints; a `Match` of the command is added if they lack one.
            command: The signal that is commanded.
            route: `auto`, `mask`, `latent` or `input`.
            search: Settings of the search.
            mask: Signals given to the network; chosen if not given.
            limits: Signal -> bounds of the search.

        Raises:
            SchemaError: The route is not known, or terms or limits are contradictory.
            UnknownSignal: A name is not in the layout.
            NotObservable: The schema does not know the command, or the mask is not feasible.
        """
        self.schema, self.command, self.route, self.mask = schema, command, route, mask
        self.limits = dict(limits or {})
        check_command(schema, command, route, mask, self.limits)
        self._search = Search(search, self.limits)
        self.terms: tuple[Term | Hold, ...] = ()
        self.constrain(terms)

    def constrain(self, terms: Sequence[Term | Hold]) -> None:
        """Continue under other constraints.

        Raises:
            UnknownSignal: A term is about a signal that is not in the layout.
        """
        terms = checked_terms(self.schema, terms)
        is_matched = any(isinstance(term, Match | Hold) and term.signal == self.command for term in terms)
        self.terms = terms if is_matched else (Match(self.command), *terms)
        self._request = Request(self.schema, self.terms)
        self._search.drop()

    def restart(self) -> None:
        """Forget the warm start."""
        self._search.restart()

    def step(
        self,
        command: np.ndarray | Sequence[float],
        given: Mapping[str, np.ndarray] | None = None,
        now: Mapping[str, np.ndarray] | None = None,
    ) -> SimulatedState:
        """Return the state that a command brings about.

        Args:
            command: The command [unit of the commanded signal], shape (n,).
            given: Signal -> reference of other terms [its unit], such as the posture of a `Hold`.
            now: Signal -> value [its unit] of the state to begin from, at the first step.

        Raises:
            WrongSize: An array does not have its signal's size.
            NotFinite: An element of the command is not a number.
            NotObservable: A term or the route cannot work with this schema.
        """
        schema = self.schema
        target = {**(given or {}), self.command: np.asarray(command, float)}
        sent = schema.normalise_one({self.command: target[self.command]})
        if not np.isfinite(sent[schema.layout.slice(self.command)]).all():
            raise NotFinite(f"The command of '{self.command}' is not finite; every element needs a number.")
        self._check(target)
        now = {} if now is None else now
        schema.layout.join_one(now)
        self._request.read(target, now)
        fixed = np.where(np.isfinite(sent), sent, self._request.held)
        outcome = self._search.find(self._request, fixed, self._choose, lambda: schema.normalise_one(now))
        values = schema.layout.split(schema.scaler.restore(outcome.x))
        state = {name: part.copy() for name, part in values.items() if np.isfinite(part).all()}
        residual = self._residual(outcome.x, sent, outcome.mask)
        return SimulatedState(state, outcome.loss, residual, outcome.route, outcome.mask)

    def run(
        self,
        commands: Iterable[np.ndarray | Sequence[float]],
        given: Mapping[str, np.ndarray] | None = None,
        now: Mapping[str, np.ndarray] | None = None,
    ) -> Iterator[SimulatedState]:
        """Yield the states that commands bring about one after the other; see `step`."""
        for command in commands:
            yield self.step(command, given, now)

    def _check(self, target: Mapping[str, np.ndarray]) -> None:
        for name in target:
            self.schema.layout.slice(name)
            if name not in self._request.needed:
                known = ", ".join(self._request.needed)
                raise NotObservable(f"The reference '{name}' is in no term. Signals of the terms: {known}.")

    def _choose(self, fixed: Mask) -> tuple[str, Mask]:
        """Choose route and mask; `fixed` are the signals that are commanded or held completely."""
        schema, terms = self.schema, self._request.terms
        if self.mask is not None:
            if self.route == "mask" and not self.mask <= fixed:
                missing = label(self.mask - fixed, schema.layout.names)
                raise NotObservable(f"Route mask needs {missing} commanded or held; use route input.")
            return self.route, self.mask
        free = [term for term in terms if not (isinstance(term, Match) and term.signal == self.command)]
        covering = best(schema.masks, fixed, lambda m: -len(m))
        if self.route == "mask" or (self.route == "auto" and not free):
            if covering is not None:
                return "mask", covering
            if self.route == "mask":
                known = label(fixed, schema.layout.names)
                raise NotObservable(f"Route mask needs a feasible mask within {known}; use route latent or input.")
        about = {name for term in terms for name in term.signals}
        if self.route == "latent" or (self.route == "auto" and about <= set(schema.x_out)):
            for name in sorted(about - set(schema.x_out)):
                raise NotObservable(f"Route latent predicts only x_out, but a term is about '{name}'; use route input.")
            return "latent", frozenset()
        inferring = [m for m in schema.masks if self.command in m or self.command in schema.x_out]
        if not inferring:
            raise NotObservable(f"No feasible mask takes '{self.command}', and it is not inferred.")
        return "input", max(inferring, key=lambda m: (self.command not in m, len(m)))

    def _residual(self, x: np.ndarray, sent: np.ndarray, mask: Mask) -> float:
        """Return the error of the state when the network predicts it from the sent command and a mask."""
        schema = self.schema
        if not mask:
            known = schema.layout.whole(np.isfinite(x))
            mask = min(
                (m for m in schema.masks if m <= known),
                key=lambda m: (self.command not in m, len(m)),
                default=frozenset(),
            )
            if not mask:
                return float("nan")
        state = np.where(np.isfinite(sent), sent, x)
        prediction = schema.infer(np.where(np.isfinite(state), state, 0.0), mask)
        return float(np.sqrt(np.mean((prediction - state[schema.out_index]) ** 2)))


def simulate(
    schema: BodySchema,
    commands: Iterable[np.ndarray | Sequence[float]],
    *,
    command: str,
    terms: Sequence[Term | Hold] = (),
    given: Mapping[str, np.ndarray] | None = None,
    now: Mapping[str, np.ndarray] | None = None,
    **options: Any,
) -> list[SimulatedState]:
    """Return the states that commands bring about one after the other; `Simulator` takes them singly.

    Args:
        schema: The body schema.
        commands: The commands [unit of the commanded signal], each of shape (n,).
        command: The signal that is commanded.
        terms: Constraints.
        given: Signal -> reference of terms that take one [its unit].
        now: Signal -> value [its unit] of the state to begin from.
        options: Of `Simulator`: route, mask, search, limits.
    """
    return list(Simulator(schema, terms, command, **options).run(commands, given, now))
