"""Control (paper, II-H): the command whose predicted outcome loses least."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gemuco.descent import DescentConfig, descend
from gemuco.errors import NotFinite, NotObservable, SchemaError
from gemuco.kernels import pull, run, trace
from gemuco.losses import Bound, Term
from gemuco.masks import Mask, covered_by
from gemuco.schema import BodySchema

ROUTES = ("auto", "input", "latent")
STARTS = 16


@dataclass(frozen=True, slots=True)
class Solution:
    """What to do, and what is expected of it.

    Attributes:
        command: The commanded signal [its unit], shape (n,).
        predicted: Signal -> its value when the command has been followed [its unit], shape (n,).
        loss: Sum of the terms.
        residual: How far the body that the command leads to, asked of the network again, is from the target (root
            mean square over the target's elements, standard deviations); NaN if no mask can tell.
        route: `mask` (usages a and b), `input` (f) or `latent` (e).
    """

    command: np.ndarray
    predicted: dict[str, np.ndarray]
    loss: float
    residual: float
    route: str


class Controller:
    """Finds commands for targets, each solve beginning where the last one ended.

    Two ways, `auto` prefers the first:

    - `input`: a feasible mask holds the target and leaves out the command, as (theta, f) does for l. The target is
      given to the network as if it were measured, and descent runs over the rest of the mask (f) inside the bounds of
      the training data. The pair stays on the data manifold, so the command does what was predicted.
    - `latent`: descent on z, as in the paper. It can end beside the manifold, where the predicted posture fits but the
      predicted command does not lead there: see `Solution.residual`.
    """

    def __init__(
        self,
        schema: BodySchema,
        terms: Sequence[Term],
        command: str,
        route: str = "auto",
        search: DescentConfig | None = None,
    ) -> None:
        """Prepare for commands of one signal.

        Raises:
            SchemaError: The route is not known.
            NotObservable: The schema does not infer the commanded signal.
        """
        if route not in ROUTES:
            raise SchemaError(f"Control route '{route}' is not known. Known routes: {', '.join(ROUTES)}.")
        self.terms = tuple(terms)
        self.command = command
        self.route = route
        self.search = search or DescentConfig(gamma_max=0.5, candidates=10, iterations=20)
        self._warm: np.ndarray | None = None
        self._asked: frozenset[str] = frozenset()
        self.swap(schema)

    def swap(self, schema: BodySchema) -> None:
        """Go on with another schema of the same body; the warm start is kept."""
        schema.layout.slice(self.command)
        if self.command not in schema.x_out:
            raise NotObservable(
                f"'{self.command}' is commanded but not inferred by this schema; it infers {', '.join(schema.x_out)}."
            )
        self.schema = schema

    def restart(self) -> None:
        """Forget the warm start."""
        self._warm = None

    def solve(self, target: Mapping[str, np.ndarray], now: Mapping[str, np.ndarray]) -> Solution:
        """The command for a target.

        Args:
            target: Signal -> reference [its unit], shape (n,).
            now: Signal -> present value [its unit], shape (n,); NaN or absent where it is not known.

        Raises:
            UnknownSignal: A name is not in the layout.
            WrongSize: An array does not have its signal's size.
            NotFinite: A target is NaN or infinite.
            NotObservable: A term or the route cannot work with this schema.
        """
        schema = self.schema
        reference = schema.normalise(target)
        for name in target:
            if not np.isfinite(reference[schema.layout.slice(name)]).all():
                raise NotFinite(f"The target of '{name}' is not finite; every element needs a number.")
        present = schema.normalise(now)
        if frozenset(target) != self._asked:
            self._asked = frozenset(target)
            self._warm = None
        bounds = [term.bind(schema, target, now) for term in self.terms]
        mask = None if self.route == "latent" else self._holding_mask(self._asked)
        if mask is None and self.route == "input":
            raise NotObservable(
                f"No feasible mask holds {', '.join(sorted(target))} and leaves out '{self.command}'; use route latent."
            )
        x, loss, route = (
            self._by_latent(bounds, present) if mask is None else self._by_input(mask, bounds, reference, present)
        )
        values = schema.scaler.restore(x)
        predicted = {name: part for name, part in schema.layout.split(values).items() if np.isfinite(part).all()}
        return Solution(predicted[self.command].copy(), predicted, loss, self._residual(x, reference), route)

    def _holding_mask(self, asked: Mask) -> Mask | None:
        fitting = [m for m in self.schema.masks if asked <= m and self.command not in m]
        return max(fitting, key=len) if fitting else None

    def _by_input(
        self, mask: Mask, bounds: list[Bound], reference: np.ndarray, present: np.ndarray
    ) -> tuple[np.ndarray, float, str]:
        schema = self.schema
        free = schema.layout.indices(mask - self._asked)
        known = np.where(np.isfinite(reference), reference, 0.0)
        base = schema.network_input(known, mask)
        columns = np.flatnonzero(np.isin(schema.in_index, free))
        inferred = np.isin(schema.out_index, schema.layout.indices(mask), invert=True)
        outputs = schema.out_index[inferred]
        needs_network = any(not set(term.signals) <= mask for term in self.terms)
        chain = schema.weights.whole

        def objective(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            x = np.repeat(known[None].astype(points.dtype), len(points), axis=0)
            x[:, free] = points
            if needs_network:
                inputs = np.repeat(base[None], len(points), axis=0)
                inputs[:, columns] = points
                values = trace(chain, inputs)
                x[:, outputs] = values[-1][:, inferred]
            loss, gradient = _sum(bounds, x)
            descent = gradient[:, free]
            if needs_network:
                out = np.zeros_like(values[-1])
                out[:, inferred] = gradient[:, outputs]
                descent = descent + pull(chain, values, out)[:, columns]
            return loss, descent

        loss = float("nan")
        if len(free):
            low, high = ((schema.scaler.normalise(b))[free].astype(np.float32) for b in self._bounds())
            found = descend(objective, self._starts(free, present), self.search, low, high)
            self._warm, loss = found.point, found.loss
            known[free] = found.point
        x = np.full(schema.layout.size, np.nan)
        held = schema.layout.indices(mask)
        x[schema.out_index] = schema.infer(known, mask)
        x[held] = known[held]
        if not len(free):
            loss = float(_sum(bounds, np.nan_to_num(x)[None])[0][0])
        return x, loss, "input" if len(free) else "mask"

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.schema.scaler.low, self.schema.scaler.high

    def _starts(self, free: np.ndarray, present: np.ndarray) -> np.ndarray:
        if self._warm is not None and len(self._warm) == len(free):
            return self._warm[None]
        starts = [self.schema.anchors[:STARTS, free]] if len(self.schema.anchors) else [np.zeros((1, len(free)))]
        if np.isfinite(present[free]).all():
            starts.append(present[None, free])
        return np.concatenate(starts).astype(np.float32)

    def _by_latent(self, bounds: list[Bound], present: np.ndarray) -> tuple[np.ndarray, float, str]:
        schema = self.schema
        decoder = schema.weights.decoder

        def objective(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            values = trace(decoder, points)
            x = np.zeros((len(points), schema.layout.size), points.dtype)
            x[:, schema.out_index] = values[-1]
            loss, gradient = _sum(bounds, x)
            return loss, pull(decoder, values, np.ascontiguousarray(gradient[:, schema.out_index]))

        found = descend(objective, self._latent_starts(present), self.search)
        self._warm = found.point
        x = np.full(schema.layout.size, np.nan)
        x[schema.out_index] = run(decoder, found.point)
        return x, found.loss, "latent"

    def _latent_starts(self, present: np.ndarray) -> np.ndarray:
        schema = self.schema
        latent = schema.weights.decoder[0].matrix.shape[0]
        if self._warm is not None and len(self._warm) == latent:
            return self._warm[None]
        covered = covered_by(schema.masks, schema.layout.whole(np.isfinite(present)))
        if covered:
            return run(schema.weights.encoder, schema.network_input(present, covered[0]))[None]
        if len(schema.anchors):
            return run(schema.weights.encoder, schema.network_input(schema.anchors[:STARTS], schema.masks[0]))
        return np.zeros((1, latent), np.float32)

    def _residual(self, x: np.ndarray, reference: np.ndarray) -> float:
        """The target asked of the network again, from the command and whatever else was found."""
        schema = self.schema
        there = schema.layout.whole(np.isfinite(x))
        judged = self._asked & set(schema.x_out)
        blind = [m for m in covered_by(schema.masks, there) if self.command in m and not m & judged]
        if not blind or not judged:
            return float("nan")
        again = np.full(schema.layout.size, np.nan)
        again[schema.out_index] = schema.infer(x, max(blind, key=len))
        index = schema.layout.indices(judged)
        return float(np.sqrt(np.mean((again[index] - reference[index]) ** 2)))


def _sum(bounds: list[Bound], x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    losses, gradients = zip(*(bound(x) for bound in bounds), strict=True)
    return np.sum(losses, axis=0), np.sum(gradients, axis=0)
