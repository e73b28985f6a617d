"""Searches along a route (`gemuco.routes`), one after the other, each from where the last one ended."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gemuco.descent import Constraint, Descent, DescentConfig, NewtonConfig, Objective, descend
from gemuco.errors import NotObservable
from gemuco.fold import around, fold
from gemuco.losses import Bound, total
from gemuco.masks import Mask
from gemuco.minimise import minimise
from gemuco.routes import InputRoute, LatentRoute, Limits, Route
from gemuco.torque import Balanced

if TYPE_CHECKING:
    from gemuco.schema import BodySchema

SLIPPED = 0.05
"""A held element this far [standard deviations] from where it shall be is not held."""
ROUNDS = 4
"""How often a torque that depends on what is predicted is made a straight line anew, at most."""
STILL = 1e-2
"""A posture that moves less than this [standard deviations] from one such round to the next is found."""


@dataclass(frozen=True, slots=True)
class Found:
    """Where a search along a route ended.

    Attributes:
        x: What is predicted there, shape (size,) [standard deviations]; NaN for what the route says nothing about.
        loss: Sum of the terms.
        is_late: Whether time was up before the search ended.
    """

    x: np.ndarray
    loss: float
    is_late: bool = False


class Search:
    """Searches along one route after the other, each beginning where the last one ended if the route is the same."""

    def __init__(self, config: DescentConfig | NewtonConfig, limits: Limits | None) -> None:
        self.config, self.limits = config, limits
        self._warm: np.ndarray | None = None
        self._way: tuple[str, Mask, int] | None = None

    def restart(self) -> None:
        """Forget where the last one ended."""
        self._warm = None

    def find(
        self,
        schema: "BodySchema",
        route: str,
        mask: Mask,
        bounds: Sequence[Bound],
        given: np.ndarray,
        held: np.ndarray,
        needed: Sequence[str],
        begin: np.ndarray,
        only_there: bool = False,
        within: float = math.inf,
    ) -> Found:
        """Minimise terms along a route.

        Args:
            schema: The body schema.
            route: `latent`; or `mask` or `input`, which differ only in how much of the mask is left free.
            mask: The inputs of the network.
            bounds: The terms.
            given: What inputs are given and not searched for [standard deviations], shape (size,); NaN where free.
            held: What predictions must equal, shape (size,) [standard deviations]; NaN where free.
            needed: Signals that the terms are about.
            begin: Where to begin [standard deviations], shape (size,); NaN where nothing is known.
            only_there: Begin nowhere else if that is known; else training data are tried too.
            within: Time that the search may take [s]; what it found until then is the result.

        Raises:
            NotObservable: What is held cannot be, or a term is about a signal that is neither given nor inferred.
        """
        way: LatentRoute | InputRoute
        if route == "latent":
            way, size = LatentRoute(schema), -1
        else:
            way = InputRoute(schema, mask, given, needed, self.limits)
            size = len(way.free)
            held = held.copy()
            held[schema.layout.indices(mask)] = np.nan
        starts = self._warm[None] if self._warm is not None and self._way == (route, mask, size) else None
        if starts is None:
            starts = way.starts(begin, only_there)
        ended = Descent(starts[0], math.nan, ())
        if size:
            ended = self._minimise(way, bounds, held, starts, time.monotonic() + within)
        x = way.final(ended.point)
        for element in np.flatnonzero(np.abs(x - held) > SLIPPED):
            reached, asked = schema.scaler.restore(x)[element], schema.scaler.restore(held)[element]
            raise NotObservable(
                f"'{schema.layout.element(int(element))}' cannot be held at {asked:.4g}: the nearest found is "
                f"{reached:.4g}. Is it within what the body can do, and within the limits?"
            )
        self._warm, self._way = ended.point, (route, mask, size)
        loss = ended.loss if size else float(total(bounds, np.nan_to_num(x)[None], False)[0][0])
        return Found(x, loss, ended.is_late)

    def _minimise(
        self,
        way: LatentRoute | InputRoute,
        bounds: Sequence[Bound],
        held: np.ndarray,
        starts: np.ndarray,
        until: float,
    ) -> Descent:
        """Compiled, or in numpy where a term is the caller's own or a descent has something to hold."""
        config, lines = self.config, way.lines()
        problem = fold(lines, bounds, held)
        if problem is None or (problem.held and isinstance(config, DescentConfig)):
            plain = config if isinstance(config, DescentConfig) else DescentConfig()
            return descend(_objective(way, bounds), starts, plain, lines.low, lines.high, _constraint(way, held))
        moving = next((one for one in bounds if isinstance(one, Balanced) and one.posture is None), None)
        if moving is None:
            return minimise(problem, starts, config, until)
        before = way.final(starts[0])
        for _ in range(ROUNDS):
            ended = minimise(around(problem, moving, before), starts, config, until)
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


def _constraint(route: Route, held: np.ndarray) -> Constraint | None:
    index = np.flatnonzero(np.isfinite(held))
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
