"""Routes of a search (paper, II-C): usage (e) searches z, from which every x_out is decoded; usage (f) searches some of
x_in, from which the network infers the other signals. Estimation, control and simulation share the routes.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np

from gemuco.compiled.chain import output, pack
from gemuco.errors import NotObservable, SchemaError, WrongSize, check_kind
from gemuco.layers import pull, run, trace
from gemuco.masks import Mask, covered_by, label
from gemuco.scaler import CLIP
from gemuco.schema import BodySchema, check_schema
from gemuco.search.fold import Lines, input_lines, latent_lines, set_inputs

STARTS = 64
"""A descent selects its start from at most this many anchors of the training data."""
ROUTES = ("auto", "mask", "latent", "input")
Limits = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""Limits map a signal to its lowest and highest value [its unit], shapes (n,)."""
Back = Callable[[np.ndarray], np.ndarray]
"""This maps gradients with respect to predictions, (candidates, size), to points, (candidates, n)."""


class Route(Protocol):
    """A map from points to predictions.

    Attributes:
        lines: The route for compiled searches.
    """

    lines: Lines

    def set_inputs(self, inputs: np.ndarray) -> None:
        """Use other fixed inputs [standard deviations], shape (size,), NaN for the same elements as before."""
        ...

    def predict(self, points: np.ndarray) -> tuple[np.ndarray, Back]:
        """Return predictions of points, and the function that maps gradients back.

        Args:
            points: Shape (candidates, n).

        Returns:
            Predictions [standard deviations], shape (candidates, size), 0 outside the route; and the function.
        """
        ...

    def final(self, point: np.ndarray) -> np.ndarray:
        """Return the prediction of a point, shape (size,) [standard deviations]; NaN outside the route."""
        ...

    def starts(self, begin: np.ndarray, is_only_start: bool = False) -> np.ndarray:
        """Return the points of a start and of training data, shape (starts, n); see `Search.find`."""
        ...


class LatentRoute:
    """Usage (e): z is searched, and every x_out is decoded from it; see `Route`."""

    def __init__(self, schema: BodySchema) -> None:
        self._schema = schema
        self._decoder = schema.weights.decoder
        self._packed, self.lines = pack(self._decoder), latent_lines(schema)

    def set_inputs(self, inputs: np.ndarray) -> None:
        """Do nothing: a decoder has no input but z."""

    def predict(self, points: np.ndarray) -> tuple[np.ndarray, Back]:
        """Decode points."""
        values = trace(self._decoder, points)
        x = np.zeros((len(points), self._schema.layout.size), points.dtype)
        x[:, self._schema.out_index] = values[-1]

        def back(gradient: np.ndarray) -> np.ndarray:
            return pull(self._decoder, values, np.ascontiguousarray(gradient[:, self._schema.out_index]))

        return x, back

    def final(self, point: np.ndarray) -> np.ndarray:
        """Decode a point, shape (size,) [standard deviations]; NaN outside x_out."""
        x = np.full(self._schema.layout.size, np.nan)
        x[self._schema.out_index] = output(self._packed, point.astype(np.float32))
        return x

    def starts(self, begin: np.ndarray, is_only_start: bool = False) -> np.ndarray:
        """Encode the start and training data."""
        schema = self._schema
        starts = []
        covered = covered_by(schema.masks, schema.layout.whole(np.isfinite(begin)))
        if covered:
            starts.append(run(schema.weights.encoder, schema.network_input(begin, covered[0]))[None])
        if not starts or (len(schema.anchors) and not is_only_start):
            starts.append(schema.derived(latent_starts))
        return np.concatenate(starts)


def latent_starts(schema: BodySchema) -> np.ndarray:
    """Return the z of some anchors, from which a descent on z selects its start, shape (n, latent), n at least 1."""
    if not len(schema.anchors):
        return np.zeros((1, schema.weights.decoder[0].matrix.shape[0]), np.float32)
    return run(schema.weights.encoder, schema.network_input(schema.anchors[:STARTS], schema.masks[0]))


class InputRoute:
    """Usage (f): the free inputs of a mask are searched, and the network infers the rest of x_out; see `Route`."""

    def __init__(
        self, schema: BodySchema, mask: Mask, inputs: np.ndarray, needed: Sequence[str], limits: Limits | None = None
    ) -> None:
        """Prepare the route.

        Args:
            schema: The body schema.
            mask: Signals of the network input.
            inputs: Fixed inputs, which are not searched [standard deviations], shape (size,); NaN where free.
            needed: Signals of the loss; the network runs if one of them is not in the mask.
            limits: Bounds of the inputs if they are narrower than those of the training data.

        Raises:
            NotObservable: A needed signal is neither in the mask nor inferred.
        """
        for name in needed:
            if name not in mask and name not in schema.x_out:
                raise NotObservable(
                    f"A term is about '{name}', which this schema does not infer ({', '.join(schema.x_out)}) and which "
                    f"is not among the inputs {label(mask, schema.layout.names)}."
                )
        inside = schema.layout.indices(mask)
        self.mask, self._schema, self._chain = mask, schema, schema.chain(mask)
        self._packed = pack(self._chain)
        self._inside, self._is_fixed = inside, np.isfinite(inputs)
        self.free = inside[~self._is_fixed[inside]]
        self._constants = np.where(self._is_fixed, inputs, 0.0)
        self._base = schema.network_input(self._constants, mask).astype(self._chain[0].matrix.dtype)
        is_free, is_inside = np.zeros((2, schema.layout.size), bool)
        is_free[self.free] = is_inside[inside] = True
        self._columns = np.flatnonzero(is_free[schema.in_index])
        self._inferred = ~is_inside[schema.out_index]
        self._outputs = schema.out_index[self._inferred]
        self._runs = any(name not in mask for name in needed)
        low, high = (bound[self.free].astype(self._base.dtype) for bound in bounds_of(schema, limits))
        self.lines = input_lines(
            schema, mask, self._base, self._columns, self.free, self._inferred, self._constants, low, high
        )

    def set_inputs(self, inputs: np.ndarray) -> None:
        """Write other fixed inputs into the network input."""
        np.copyto(self._constants, inputs, where=self._is_fixed)
        self._base[:] = self._schema.network_input(self._constants, self.mask)
        set_inputs(self.lines, self._chain[0], self._base, self._columns, self._constants)

    def predict(self, points: np.ndarray) -> tuple[np.ndarray, Back]:
        """Run the network on points."""
        x = np.repeat(self._constants[None].astype(points.dtype), len(points), axis=0)
        x[:, self.free] = points
        if not self._runs:
            return x, lambda gradient: gradient[:, self.free]
        inputs = np.repeat(self._base[None], len(points), axis=0)
        inputs[:, self._columns] = points
        values = trace(self._chain, inputs)
        x[:, self._outputs] = values[-1][:, self._inferred]

        def back(gradient: np.ndarray) -> np.ndarray:
            out = np.zeros_like(values[-1])
            out[:, self._inferred] = gradient[:, self._outputs]
            return gradient[:, self.free] + pull(self._chain, values, out)[:, self._columns]

        return x, back

    def final(self, point: np.ndarray) -> np.ndarray:
        """Run the network on a point, shape (size,) [standard deviations]; NaN outside the mask and x_out."""
        schema = self._schema
        inputs = self._base.astype(np.float32)
        inputs[self._columns] = point
        x = np.full(schema.layout.size, np.nan)
        x[schema.out_index] = output(self._packed, inputs)
        x[self._inside] = self._constants[self._inside]
        x[self.free] = point
        return x

    def starts(self, begin: np.ndarray, is_only_start: bool = False) -> np.ndarray:
        """Return the free inputs of the start and of training data."""
        starts = []
        if np.isfinite(begin[self.free]).all():
            starts.append(begin[None, self.free])
        if len(self._schema.anchors) and not (starts and is_only_start):
            starts.append(self._schema.anchors[:STARTS, self.free])
        return np.concatenate(starts or [np.zeros((1, len(self.free)))]).astype(np.float32)


def bounds_of(schema: BodySchema, limits: Limits | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of a search: the range of the training data, narrowed by the limits.

    Raises:
        UnknownSignal: A limit is of a signal that is not in the layout.
        WrongSize: A limit does not have its signal's size.
        SchemaError: A lower limit is above its upper limit.

    Returns:
        Lowest and highest value of every element [standard deviations], shapes (size,).
    """
    scaler = schema.scaler
    low, high = scaler.normalise(scaler.low).clip(-CLIP, CLIP), scaler.normalise(scaler.high).clip(-CLIP, CLIP)
    for name, pair in (limits or {}).items():
        span = schema.layout.slice(name)
        if len(pair) != 2:
            raise WrongSize(f"The limits of '{name}' are a lower and an upper bound, not {len(pair)} values.")
        bounds = [schema.layout.join({name: np.asarray(bound, float)}) for bound in pair]
        below, above = (scaler.normalise(bound)[span] for bound in bounds)
        if not (below <= above).all():
            raise SchemaError(f"A lower limit of '{name}' is above its upper limit, or is not a number.")
        low[span], high[span] = low[span].clip(below, above), high[span].clip(below, above)
    return low, high


def check_command(schema: BodySchema, command: str, route: str, mask: Mask | None, limits: Limits) -> None:
    """Check a commanded signal and the settings of its route.

    Raises:
        WrongKind: The first argument is not a body schema, or the command is not a name.
        UnknownSignal: The command or a limit names a signal that is not in the layout.
        SchemaError: The route is not known, does not allow a mask, or limits are contradictory.
        NotObservable: The command is neither input nor output of the network, or the mask is not feasible.
    """
    check_schema(schema)
    check_kind("The command", command, str, "the name of a signal")
    schema.layout.slice(command)
    if route not in ROUTES:
        raise SchemaError(f"Route '{route}' is not known. Known routes: {', '.join(ROUTES)}.")
    if mask is not None and route in ("latent", "auto"):
        raise SchemaError(f"A mask goes with route mask or input, not with '{route}'.")
    if command not in (*schema.x_in, *schema.x_out):
        raise NotObservable(
            f"'{command}' is commanded, but is neither input nor output of this schema. Inputs: "
            f"{', '.join(schema.x_in)}. Outputs: {', '.join(schema.x_out)}."
        )
    if mask is not None and mask not in schema.masks:
        known = ", ".join(label(m, schema.layout.names) for m in schema.masks)
        raise NotObservable(
            f"The mask {label(mask, schema.layout.names) or ', '.join(sorted(mask))} is not feasible for this schema. "
            f"Feasible masks: {known}."
        )
    bounds_of(schema, limits)
