"""Searches along a route (`gemuco.search.routes`), one after the other, each from where the last one ended.

What depends on terms, route and limits alone is laid out at the first search and kept; what is wanted, given and held
is then written into it as numbers.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gemuco.errors import NotObservable
from gemuco.masks import Mask
from gemuco.search.asked import Asked
from gemuco.search.descent import Constraint, Descent, DescentConfig, NewtonConfig, Objective, descend, minimise
from gemuco.search.fold import Folded, around, fold
from gemuco.search.norms import Bound, total
from gemuco.search.routes import InputRoute, LatentRoute, Limits, Route

SLIPPED = 0.05
"""A held element this far [standard deviations] from where it shall be is not held."""
ROUNDS = 4
"""How often a torque that depends on what is predicted is made a straight line anew, at most."""
STILL = 1e-2
"""A posture that moves less than this [standard deviations] from one such round to the next is found."""


KEPT = 16
"""Layouts kept; as many patterns of what is given and what is not."""
Choose = Callable[[Mask], tuple[str, Mask]]
"""Signals whose whole value is given -> route and mask; as many times asked as there are patterns."""


@dataclass(frozen=True, slots=True)
class Found:
    """Where a search along a route ended.

    Attributes:
        x: What is predicted there, shape (size,) [standard deviations]; NaN for what the route says nothing about.
        loss: Sum of the terms.
        route: `mask`, `latent` or `input`.
        mask: The signals that the network was given; empty for `latent`.
        is_late: Whether time was up before the search ended.
    """

    x: np.ndarray
    loss: float
    route: str
    mask: Mask
    is_late: bool = False


@dataclass(frozen=True, slots=True)
class Laid:
    """What is the same for all searches that ask the same and are given the same elements.

    Attributes:
        route: See `Found`.
        mask: See `Found`.
        way: What moves.
        size: How many numbers; -1 for z.
        held: Elements of the layout that are held and not given to the network, shape (n,).
        folded: The problem for compiled searches; None if it is searched for in numpy.
    """

    route: str
    mask: Mask
    way: LatentRoute | InputRoute
    size: int
    held: np.ndarray
    folded: Folded | None


class Search:
    """Searches along one route after the other, each beginning where the last one ended if the route is the same."""

    def __init__(self, config: DescentConfig | NewtonConfig, limits: Limits | None) -> None:
        self.config, self.limits = config, limits
        self._warm: np.ndarray | None = None
        self._way: tuple[str, Mask, int] | None = None
        self._laid: dict[tuple[Asked, bytes, bytes], Laid] = {}

    def restart(self) -> None:
        """Forget where the last one ended."""
        self._warm = None

    def drop(self) -> None:
        """Lay everything out anew: terms or schema are others; where the last one ended is kept."""
        self._laid.clear()

    def find(
        self,
        asked: Asked,
        given: np.ndarray,
        choose: Choose,
        begin: Callable[[], np.ndarray],
        only_there: bool = False,
        within: float = math.inf,
    ) -> Found:
        """Minimise terms along a route.

        Args:
            asked: The terms, after `Asked.read`.
            given: What inputs are given and not searched for [standard deviations], shape (size,); NaN where free.
            choose: Route and mask.
            begin: Where to begin [standard deviations], shape (size,), NaN where nothing is known; asked for if the
                last search went another way.
            only_there: Begin nowhere else if that is known; else training data are tried too.
            within: Time that the search may take [s]; what it found until then is the result.

        Raises:
            NotObservable: What is held cannot be, or a term is about a signal that is neither given nor inferred.
        """
        until = time.monotonic() + within
        laid = self._lay(asked, given, choose)
        way, size, now = laid.way, laid.size, (laid.route, laid.mask, laid.size)
        way.give(given)
        starts = self._warm[None] if self._warm is not None and self._way == now else None
        if starts is None:
            starts = way.starts(begin(), only_there)
        ended = Descent(starts[0], math.nan, ())
        if size:
            ended = self._minimise(laid, asked, starts, until)
        x = way.final(ended.point)
        for element in laid.held[np.abs(x[laid.held] - asked.held[laid.held]) > SLIPPED] if len(laid.held) else ():
            restored, held = (asked.schema.scaler.restore(one)[element] for one in (x, asked.held))
            raise NotObservable(
                f"'{asked.schema.layout.element(int(element))}' cannot be held at {held:.4g}: the nearest found is "
                f"{restored:.4g}. Is it within what the body can do, and within the limits?"
            )
        self._warm, self._way = ended.point, now
        loss = ended.loss if size else float(total(asked.bounds, np.nan_to_num(x)[None], False)[0][0])
        return Found(x, loss, laid.route, laid.mask, ended.is_late)

    def _lay(self, asked: Asked, given: np.ndarray, choose: Choose) -> Laid:
        """The layout for what is asked and which elements are given; kept unless a term may be anything each time."""
        key = asked, asked.pattern(), np.isfinite(given).tobytes()
        laid = self._laid.get(key) if asked.is_lasting else None
        if laid is not None:
            return laid
        schema = asked.schema
        route, mask = choose(schema.layout.whole(np.isfinite(given)))
        held = np.isfinite(asked.held)
        way: LatentRoute | InputRoute
        if route == "latent":
            way, size = LatentRoute(schema), -1
        else:
            way = InputRoute(schema, mask, given, asked.needed, self.limits)
            size = len(way.free)
            held[schema.layout.indices(mask)] = False
        folded = None
        if size and not (held.any() and isinstance(self.config, DescentConfig)):
            folded = fold(way.lines(), asked.bounds, np.where(held, asked.held, np.nan))
        laid = Laid(route, mask, way, size, np.flatnonzero(held), folded)
        if len(self._laid) >= KEPT:
            self._laid.clear()
        if asked.is_lasting:
            self._laid[key] = laid
        return laid

    def _minimise(self, laid: Laid, asked: Asked, starts: np.ndarray, until: float) -> Descent:
        """Compiled, or in numpy where a term is the caller's own or a descent has something to hold."""
        config, way, folded = self.config, laid.way, laid.folded
        if folded is None:
            plain, lines = config if isinstance(config, DescentConfig) else DescentConfig(), way.lines()
            held = _constraint(way, laid.held, asked.held)
            return descend(_objective(way, asked.bounds), starts, plain, lines.low, lines.high, held)
        folded.fill(asked.held)
        moving = folded.moving
        if moving is None:
            return minimise(folded.problem, starts, config, until)
        before = way.final(starts[0])
        for _ in range(ROUNDS):
            ended = minimise(around(folded.problem, moving, before), starts, config, until)
            x = way.final(ended.point)
            starts = ended.point[None]
            if ended.is_late or np.abs(x - before)[moving.theta].max() < STILL:
                break
            before = x
        return ended


def _objective(route: Route, bounds: Sequence[Bound]) -> Objective:
    def objective(points: np.ndarray, slope: bool) -> tuple[np.ndarray, np.ndarray]:
        x, back = route.predict(points)
        loss, gradient = total(bounds, x, slope)
        return loss, back(gradient) if slope else gradient

    return objective


def _constraint(route: Route, index: np.ndarray, held: np.ndarray) -> Constraint | None:
    if not len(index):
        return None
    wanted = held[index]

    def constraint(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, back = route.predict(points)
        rows = []
        for element in index:
            one = np.zeros_like(x)
            one[:, element] = 1.0
            rows.append(back(one))
        return x[:, index] - wanted.astype(x.dtype), np.stack(rows, axis=1)

    return constraint
