"""Searches along a route (`gemuco.search.routes`), one after the other, each from the end of the last one.

What depends on terms, route and limits alone is set up at the first search and kept; references, given and held values
are then written into it as numbers.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gemuco.errors import NotObservable
from gemuco.masks import Mask
from gemuco.search.descent import Constraint, Descent, DescentConfig, NewtonConfig, Objective, descend, minimise
from gemuco.search.fold import FoldedProblem, around, fold
from gemuco.search.norms import Bound, total
from gemuco.search.request import Request
from gemuco.search.routes import InputRoute, LatentRoute, Limits, Route

SLIPPED = 0.05
"""A held element further than this from its value [standard deviations] is not held."""
ROUNDS = 4
"""A torque that depends on the prediction is linearised at most this many times."""
STILL = 1e-2
"""A posture that moves less than this between two linearisations [standard deviations] is final."""
KEPT = 16
"""At most this many setups are kept, one for each pattern of given elements."""
Choose = Callable[[Mask], tuple[str, Mask]]
"""A choice maps the completely given signals to the name of a route and a mask; called once per pattern."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a search along a route.

    Attributes:
        x: Prediction, shape (size,) [standard deviations]; NaN for elements outside of the route.
        loss: Sum of the terms.
        route: `mask`, `latent` or `input`.
        mask: The signals given to the network; empty for `latent`.
        is_late: Whether the deadline ended the search.
    """

    x: np.ndarray
    loss: float
    route: str
    mask: Mask
    is_late: bool = False


@dataclass(frozen=True, slots=True)
class Setup:
    """Everything that is the same for all searches with the same terms and the same given elements.

    Attributes:
        name: `mask`, `latent` or `input`.
        mask: See `Outcome`.
        route: The route.
        size: Number of searched elements; -1 for z.
        held: Elements of the layout that are held and not given to the network, shape (n,).
        folded: The problem for compiled searches; None if the search is in numpy.
    """

    name: str
    mask: Mask
    route: Route
    size: int
    held: np.ndarray
    folded: FoldedProblem | None


class Search:
    """Searches one after the other, each beginning at the end of the last one if the route is the same."""

    def __init__(self, config: DescentConfig | NewtonConfig | None, limits: Limits | None) -> None:
        self.config, self.limits = config or NewtonConfig(), limits
        self._warm: np.ndarray | None = None
        self._last: tuple[str, Mask, int] | None = None
        self._setups: dict[tuple[Request, bytes, bytes], Setup] = {}

    def restart(self) -> None:
        """Forget the end of the last search."""
        self._warm = None

    def drop(self) -> None:
        """Forget all setups, for terms or schema are others; the end of the last search is kept."""
        self._setups.clear()

    def find(
        self,
        request: Request,
        given: np.ndarray,
        choose: Choose,
        begin: Callable[[], np.ndarray],
        only_there: bool = False,
        within: float = math.inf,
    ) -> Outcome:
        """Minimise terms along a route.

        Args:
            request: The terms, after `Request.read`.
            given: Inputs that are given and not searched [standard deviations], shape (size,); NaN where free.
            choose: Chooses route and mask.
            begin: Returns the start [standard deviations], shape (size,), NaN where not known; called if the last
                search had another route.
            only_there: Begin nowhere else if the start is known; else training data are tried too.
            within: Time limit of the search [s]; the best point until then is the result.

        Raises:
            NotObservable: An element cannot be held, or the signal of a term is neither given nor inferred.
        """
        until = time.monotonic() + within
        setup = self._setup(request, given, choose)
        route, now = setup.route, (setup.name, setup.mask, setup.size)
        route.give(given)
        starts = self._warm[None] if self._warm is not None and self._last == now else None
        if starts is None:
            starts = route.starts(begin(), only_there)
        end = self._minimise(setup, request, starts, until) if setup.size else Descent(starts[0], math.nan, ())
        x = route.final(end.point)
        if len(setup.held):
            _check_held(request, x, setup.held)
        self._warm, self._last = end.point, now
        loss = end.loss if setup.size else float(total(request.bounds, np.nan_to_num(x)[None], False)[0][0])
        return Outcome(x, loss, setup.name, setup.mask, end.is_late)

    def _setup(self, request: Request, given: np.ndarray, choose: Choose) -> Setup:
        """Return the setup for terms and given elements; it is kept unless a term may differ in any way."""
        key = request, request.pattern(), np.isfinite(given).tobytes()
        setup = self._setups.get(key) if request.is_lasting else None
        if setup is not None:
            return setup
        schema = request.schema
        name, mask = choose(schema.layout.whole(np.isfinite(given)))
        held = np.isfinite(request.held)
        route: LatentRoute | InputRoute
        if name == "latent":
            route, size = LatentRoute(schema), -1
        else:
            route = InputRoute(schema, mask, given, request.needed, self.limits)
            size = len(route.free)
            held[schema.layout.indices(mask)] = False
        folded = None
        if size and not (held.any() and isinstance(self.config, DescentConfig)):
            folded = fold(route.lines, request.bounds, np.where(held, request.held, np.nan))
        setup = Setup(name, mask, route, size, np.flatnonzero(held), folded)
        if len(self._setups) >= KEPT:
            self._setups.clear()
        if request.is_lasting:
            self._setups[key] = setup
        return setup

    def _minimise(self, setup: Setup, request: Request, starts: np.ndarray, until: float) -> Descent:
        """Search in compiled code, or in numpy where a term is the caller's own or a descent holds an element."""
        config, route, folded = self.config, setup.route, setup.folded
        if folded is None:
            descent, lines = config if isinstance(config, DescentConfig) else DescentConfig(), route.lines
            constraint = _constraint(route, setup.held, request.held)
            return descend(_objective(route, request.bounds), starts, descent, lines.low, lines.high, constraint)
        folded.fill(request.held)
        moving = folded.moving
        if moving is None:
            return minimise(folded.problem, starts, config, until)
        before = route.final(starts[0])
        for _ in range(ROUNDS):
            end = minimise(around(folded.problem, moving, before), starts, config, until)
            x = route.final(end.point)
            starts = end.point[None]
            if end.is_late or np.abs(x - before)[moving.theta].max() < STILL:
                break
            before = x
        return end


def _check_held(request: Request, x: np.ndarray, held: np.ndarray) -> None:
    """Refuse a result that misses a held element.

    Raises:
        NotObservable: An element cannot be held at its value.
    """
    for element in held[np.abs(x[held] - request.held[held]) > SLIPPED]:
        nearest, value = (request.schema.scaler.restore(vector)[element] for vector in (x, request.held))
        raise NotObservable(
            f"'{request.schema.layout.element(int(element))}' cannot be held at {value:.4g}: the nearest solution is "
            f"{nearest:.4g}. Is it within what the body can do, and within the limits?"
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
