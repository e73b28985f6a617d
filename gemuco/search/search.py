"""Successive searches along a route (`gemuco.search.routes`), each starting from the result of the previous one.

The setup, which depends on terms, route and limits, is made at the first search and kept. References, fixed inputs and
held values are written into it before each search.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gemuco.errors import NotObservable
from gemuco.masks import Mask
from gemuco.search.descent import Constraint, Descent, DescentConfig, NewtonConfig, Objective, descend, minimise
from gemuco.search.fold import FoldedProblem, fold, linearised
from gemuco.search.norms import Bound, total
from gemuco.search.request import Request
from gemuco.search.routes import InputRoute, LatentRoute, Limits, Route

HOLD_TOLERANCE = 0.05
"""A constraint is not satisfied if an element is further than this from its value [standard deviations]."""
LINEARISATIONS = 4
"""A torque that depends on the prediction is linearised at most this many times."""
POSTURE_TOLERANCE = 1e-2
"""A posture that moves less than this between two linearisations [standard deviations] is final."""
SETUPS = 16
"""At most this many setups are kept, one per pattern of fixed inputs."""
Choose = Callable[[Mask], tuple[str, Mask]]
"""This maps the signals whose elements are all fixed to the name of a route and a mask; called once per pattern."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a search along a route.

    Attributes:
        x: Prediction, shape (size,) [standard deviations]; NaN outside the route.
        loss: Sum of the terms.
        route: `mask`, `latent` or `input`.
        mask: Signals given to the network; empty for `latent`.
        is_late: Whether the deadline ended the search.
    """

    x: np.ndarray
    loss: float
    route: str
    mask: Mask
    is_late: bool = False


@dataclass(frozen=True, slots=True)
class Setup:
    """Values that all searches with the same terms and the same fixed elements share.

    Attributes:
        name: `mask`, `latent` or `input`.
        mask: See `Outcome`.
        route: The route.
        size: Number of searched elements; -1 for z.
        held: Elements of the layout that are held but not in the mask, shape (n,).
        folded: The problem for a compiled search; None for a search in numpy.
    """

    name: str
    mask: Mask
    route: Route
    size: int
    held: np.ndarray
    folded: FoldedProblem | None


class Search:
    """Successive searches. Each starts from the result of the previous one if the route is the same."""

    def __init__(self, config: DescentConfig | NewtonConfig | None, limits: Limits | None) -> None:
        self.config, self.limits = config or NewtonConfig(), limits
        self._warm: np.ndarray | None = None
        self._last: tuple[str, Mask, int] | None = None
        self._setups: dict[tuple[Request, bytes, bytes], Setup] = {}

    def restart(self) -> None:
        """Forget the result of the last search."""
        self._warm = None

    def drop(self) -> None:
        """Forget all setups, after a change of terms or schema; the result of the last search is kept."""
        self._setups.clear()

    def find(
        self,
        request: Request,
        inputs: np.ndarray,
        choose: Choose,
        start: Callable[[], np.ndarray],
        is_only_start: bool = False,
        within: float = math.inf,
    ) -> Outcome:
        """Minimise terms along a route.

        Args:
            request: The terms, after `Request.read`.
            inputs: Fixed inputs, which are not searched [standard deviations], shape (size,); NaN where free.
            choose: Chooses route and mask.
            start: Returns the start [standard deviations], shape (size,), NaN where unknown; called if the last search
                had another route.
            is_only_start: Whether a known start is the only one; otherwise training data are tried too.
            within: Time limit of the search [s]; the result is then the best point found.

        Raises:
            NotObservable: An element cannot be held, or the signal of a term is neither in the mask nor inferred.
        """
        until = time.monotonic() + within
        setup = self._setup(request, inputs, choose)
        route, key = setup.route, (setup.name, setup.mask, setup.size)
        route.set_inputs(inputs)
        if self._warm is not None and self._last == key:
            starts = self._warm[None]
        else:
            starts = route.starts(start(), is_only_start)
        end = self._minimise(setup, request, starts, until) if setup.size else Descent(starts[0], math.nan, ())
        x = route.final(end.point)
        if len(_missed(request, x, setup.held)):  # a singular start, such as a straight arm, has no way to the value
            end = self._minimise(setup, request, route.starts(start()), until)
            x = route.final(end.point)
            _check_held(request, x, setup.held)
        self._warm, self._last = end.point, key
        loss = end.loss if setup.size else float(total(request.bounds, np.nan_to_num(x)[None], False)[0][0])
        return Outcome(x, loss, setup.name, setup.mask, end.is_late)

    def _setup(self, request: Request, inputs: np.ndarray, choose: Choose) -> Setup:
        """Return the setup for terms and fixed elements; it is kept if `Request.is_lasting`."""
        key = request, request.pattern(), np.isfinite(inputs).tobytes()
        setup = self._setups.get(key) if request.is_lasting else None
        if setup is not None:
            return setup
        schema = request.schema
        name, mask = choose(schema.layout.whole(np.isfinite(inputs)))
        held = np.isfinite(request.held)
        route: LatentRoute | InputRoute
        if name == "latent":
            route, size = LatentRoute(schema), -1
        else:
            route = InputRoute(schema, mask, inputs, request.needed, self.limits)
            size = len(route.free)
            held[schema.layout.indices(mask)] = False
        folded = None
        if size and not (held.any() and isinstance(self.config, DescentConfig)):
            folded = fold(route.lines, request.bounds, np.where(held, request.held, np.nan))
        setup = Setup(name, mask, route, size, np.flatnonzero(held), folded)
        if len(self._setups) >= SETUPS:
            self._setups.clear()
        if request.is_lasting:
            self._setups[key] = setup
        return setup

    def _minimise(self, setup: Setup, request: Request, starts: np.ndarray, until: float) -> Descent:
        """Search in compiled code, or in numpy for a user's own term or a gradient descent with a constraint."""
        config, route, folded = self.config, setup.route, setup.folded
        if folded is None:
            descent, lines = config if isinstance(config, DescentConfig) else DescentConfig(), route.lines
            constraint = _constraint(route, setup.held, request.held)
            return descend(_objective(route, request.bounds), starts, descent, lines.low, lines.high, constraint)
        folded.fill(request.held)
        moving = folded.moving
        if moving is None:
            return minimise(folded.problem, starts, config, until)
        previous = route.final(starts[0])
        for _ in range(LINEARISATIONS):
            end = minimise(linearised(folded.problem, moving, previous), starts, config, until)
            x = route.final(end.point)
            starts = end.point[None]
            if end.is_late or np.abs(x - previous)[moving.theta].max() < POSTURE_TOLERANCE:
                break
            previous = x
        return end


def _missed(request: Request, x: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return the held elements that a prediction, shape (size,) [standard deviations], does not hold, shape (n,)."""
    return held[np.abs(x[held] - request.held[held]) > HOLD_TOLERANCE]


def _check_held(request: Request, x: np.ndarray, held: np.ndarray) -> None:
    """Refuse a result that does not satisfy a constraint.

    Raises:
        NotObservable: An element cannot be held at its value.
    """
    for element in _missed(request, x, held):
        nearest, value = (request.schema.scaler.restore(vector)[element] for vector in (x, request.held))
        raise NotObservable(
            f"'{request.schema.layout.element(int(element))}' cannot be held at {value:.4g}: the nearest solution is "
            f"{nearest:.4g}. Check that the value is possible for the body and within the limits."
        )


def _objective(route: Route, bounds: Sequence[Bound]) -> Objective:
    def objective(points: np.ndarray, slope: bool) -> tuple[np.ndarray, np.ndarray]:
        x, back = route.predict(points)
        loss, gradient = total(bounds, x, slope)
        return loss, back(gradient) if slope else gradient

    return objective


def _constraint(route: Route, index: np.ndarray, held: np.ndarray) -> Constraint | None:
    if not len(index):
        return None
    reference = held[index]

    def constraint(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, back = route.predict(points)
        rows = []
        for element in index:
            unit = np.zeros_like(x)
            unit[:, element] = 1.0
            rows.append(back(unit))
        return x[:, index] - reference.astype(x.dtype), np.stack(rows, axis=1)

    return constraint
