"""Simulation (paper, II-J): the states of the body that result from commands and constraints, step by step."""

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
        values: Signal -> value [its unit], shape (n,); for the commanded signal the reached value.
        loss: Sum of the terms.
        residual: Root mean square over x_out of the state minus the network's prediction from it [standard deviations].
            It is large if the state is outside the manifold of the data or the command is not reached; NaN if no mask
            allows the prediction.
        route: `mask` (usages a and b), `latent` (e) or `input` (f).
        mask: Signals given to the network; empty for `latent`.
    """

    values: dict[str, np.ndarray]
    loss: float
    residual: float
    route: str
    mask: Mask


class Simulator:
    """A simulation from state to state. Each search starts from the previous state.

    Route `auto` selects a route by the paper's rule for estimation:

    - `mask`: there are no terms, and the commanded and held signals include a feasible mask.
    - `latent`: z is searched; all terms are about x_out.
    - `input`: some of x_in are searched.

    With route `input` a mask can be specified. If the mask contains the command, the command is given to the network;
    otherwise it is inferred and matched, such as l under (theta, f), and every state is consistent for the network.
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
        """Prepare the simulation for commands of one signal.

        Args:
            schema: The body schema.
            terms: Constraints; a `Match` of the command is added if there is none.
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
        """Use other constraints from now on.

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
        """Return the state after a command.

        Args:
            command: The command [unit of the commanded signal], shape (n,).
            given: Signal -> reference of other terms [its unit], such as the posture of a `Hold`.
            now: Signal -> value [its unit] of the initial state, used at the first step.

        Raises:
            WrongSize: An array does not have its signal's size.
            NotFinite: An element of the command is not a number.
            NotObservable: A term or the route cannot work with this schema.
        """
        schema = self.schema
        target = {**(given or {}), self.command: np.asarray(command, float)}
        commanded = schema.normalise_one({self.command: target[self.command]})
        if not np.isfinite(commanded[schema.layout.slice(self.command)]).all():
            raise NotFinite(f"The command of '{self.command}' is not finite; every element needs a number.")
        self._check(target)
        now = {} if now is None else now
        schema.layout.join_one(now)
        self._request.read(target, now)
        inputs = np.where(np.isfinite(commanded), commanded, self._request.held)
        outcome = self._search.find(self._request, inputs, self._choose, lambda: schema.normalise_one(now))
        values = schema.layout.split(schema.scaler.restore(outcome.x))
        state = {name: value.copy() for name, value in values.items() if np.isfinite(value).all()}
        residual = self._residual(outcome.x, commanded, outcome.mask)
        return SimulatedState(state, outcome.loss, residual, outcome.route, outcome.mask)

    def run(
        self,
        commands: Iterable[np.ndarray | Sequence[float]],
        given: Mapping[str, np.ndarray] | None = None,
        now: Mapping[str, np.ndarray] | None = None,
    ) -> Iterator[SimulatedState]:
        """Yield the state after each command; see `step`."""
        for command in commands:
            yield self.step(command, given, now)

    def _check(self, target: Mapping[str, np.ndarray]) -> None:
        for name in target:
            self.schema.layout.slice(name)
            if name not in self._request.needed:
                signals = ", ".join(self._request.needed)
                raise NotObservable(f"The reference '{name}' is in no term. Signals of the terms: {signals}.")

    def _choose(self, inputs: Mask) -> tuple[str, Mask]:
        """Choose route and mask from the signals whose elements are all commanded or held."""
        schema, terms = self.schema, self._request.terms
        if self.mask is not None:
            if self.route == "mask" and not self.mask <= inputs:
                missing = label(self.mask - inputs, schema.layout.names)
                raise NotObservable(f"Route mask needs {missing} commanded or held; use route input.")
            return self.route, self.mask
        constraints = [term for term in terms if not (isinstance(term, Match) and term.signal == self.command)]
        largest = best(schema.masks, inputs, lambda m: -len(m))
        if self.route == "mask" or (self.route == "auto" and not constraints):
            if largest is not None:
                return "mask", largest
            if self.route == "mask":
                names = label(inputs, schema.layout.names)
                raise NotObservable(f"Route mask needs a feasible mask within {names}; use route latent or input.")
        signals = {name for term in terms for name in term.signals}
        if self.route == "latent" or (self.route == "auto" and signals <= set(schema.x_out)):
            for name in sorted(signals - set(schema.x_out)):
                raise NotObservable(f"Route latent predicts only x_out, but a term is about '{name}'; use route input.")
            return "latent", frozenset()
        masks = [m for m in schema.masks if self.command in m or self.command in schema.x_out]
        if not masks:
            raise NotObservable(f"No feasible mask contains '{self.command}', and it is not inferred.")
        return "input", max(masks, key=lambda m: (self.command not in m, len(m)))

    def _residual(self, x: np.ndarray, commanded: np.ndarray, mask: Mask) -> float:
        """Return the error of the state when the network predicts it from the command and a mask."""
        schema = self.schema
        if not mask:
            available = schema.layout.whole(np.isfinite(x))
            mask = min(
                (m for m in schema.masks if m <= available),
                key=lambda m: (self.command not in m, len(m)),
                default=frozenset(),
            )
            if not mask:
                return float("nan")
        state = np.where(np.isfinite(commanded), commanded, x)
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
    """Return the state after each command; a `Simulator` takes one command at a time.

    Args:
        schema: The body schema.
        commands: The commands [unit of the commanded signal], each of shape (n,).
        command: The signal that is commanded.
        terms: Constraints.
        given: Signal -> reference [its unit] of other terms, such as the posture of a `Hold`.
        now: Signal -> value [its unit] of the initial state.
        options: Further arguments of `Simulator`: route, mask, search, limits.
    """
    return list(Simulator(schema, terms, command, **options).run(commands, given, now))
