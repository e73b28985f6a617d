"""Estimates beyond what was learned: an output that is linear within it follows the linear path alone.

The network's correction of such an output is a detail of the learned samples. Beyond them it is arbitrary. So are the
weights of inputs that only went together in these samples, and the path is that of as few inputs as do no harm. What
all inputs say more is added where regressions without a part of the samples agree on it, and where it is not much more
than it is within them. Where the body is not linear the network is better there too.
"""

from typing import NamedTuple

import numpy as np

from gemuco.adaption.innovation import own_bias
from gemuco.masks import Mask
from gemuco.schema import BodySchema

LINEAR = 0.05
"""An output is linear if the network's correction of the linear path, root mean square over the anchors, is below this
many standard deviations: the path explains 99.75 % of its variance."""
AGREED, USUAL, STEEP = 4.0, 6.0, 4
"""Half of what all inputs say more is added where its standard error is the first number of times what it usually is,
and half where it is itself the second number of times that; the third is the power with which the shares fall."""


class Line(NamedTuple):
    """The linear path of the outputs that are linear under a mask.

    Attributes:
        inputs: Indices in the layout of the elements that the mask lets through, shape (n,).
        outputs: Indices in the layout of the outputs, shape (k,).
        few: The outputs [unit] by the inputs [unit] and 1, of which few are used, shape (n + 1, k).
        more: What all inputs say more than the few, shape (n + 1, k).
        usual: Root mean square of that over the anchors [unit], shape (k,).
        parts: The outputs by all inputs, learned without each part of the samples, shape (parts, n + 1, k).
    """

    inputs: np.ndarray
    outputs: np.ndarray
    few: np.ndarray
    more: np.ndarray
    usual: np.ndarray
    parts: np.ndarray

    def take_over(self, joined: np.ndarray, inside: float, missing: np.ndarray, value: np.ndarray) -> None:
        """Mix the path into the estimates of the missing outputs.

        Args:
            joined: Every element of the layout [its unit], shape (size,).
            inside: Share of the estimate as it is; the rest is the path.
            missing: Whether each element is estimated, truth values, shape (size,).
            value: Every element [its unit], shape (size,); the estimates are changed in place.
        """
        row = np.append(joined[self.inputs], 1.0)
        error = (row @ self.parts).std(axis=0) * np.sqrt(len(self.parts) - 1)  # the jackknife's standard error
        more, usual = row @ self.more, np.maximum(self.usual, 1e-12)
        share = 1.0 / ((1.0 + (error / usual / AGREED) ** STEEP) * (1.0 + (more / usual / USUAL) ** STEEP))
        straight = row @ self.few + share * more
        mixed = inside * value[self.outputs] + (1.0 - inside) * straight
        value[self.outputs] = np.where(missing[self.outputs], mixed, value[self.outputs])


def line_of(schema: BodySchema, mask: Mask) -> Line | None:
    """Return the linear path of the outputs that are linear under a mask; None if there are none, or no anchors."""
    if not schema.path.width or not len(schema.anchors):
        return None
    certainty = schema.certainty
    kept = None if certainty is None else certainty.known.get(("line", mask))
    if kept is None or kept[0] is not schema.weights:
        kept = schema.weights, _line(schema, mask)
        if certainty is not None:
            certainty.known["line", mask] = kept
    return kept[1]


def _line(schema: BodySchema, mask: Mask) -> Line | None:
    through = schema.gate(mask).through > 0
    inputs = schema.in_index[through]
    anchors = schema.anchors.astype(float)
    path = schema.path.direct(through, np.zeros(len(schema.out_index)))[:-1].astype(float)
    matrix = path[np.append(through, True)]
    whole = schema.infer(anchors, mask, own_bias(schema, len(anchors)) if len(schema.bias) else None)
    correction = np.sqrt(np.mean((anchors[:, inputs] @ matrix[:-1] + matrix[-1] - whole) ** 2, axis=0))
    mean, std = schema.scaler.mean, schema.scaler.std
    follows = np.flatnonzero(correction < LINEAR)
    if not len(follows):
        return None
    known, outputs = np.append(through, True), schema.out_index[follows]

    def in_units(lines: np.ndarray) -> np.ndarray:
        """Return lines of standard deviations, shape (k, ..., in_size + 1), in units, shape (..., n + 1, k)."""
        lines = np.moveaxis(lines[..., known], 0, -1) * std[outputs]
        lines[..., :-1, :] /= std[inputs][:, None]
        lines[..., -1, :] += mean[outputs] - mean[inputs] @ lines[..., :-1, :]
        return lines

    few = in_units(np.stack([schema.path.by_few(through, int(output)) for output in follows]))
    every = in_units(np.stack([schema.path.by_all(through, int(output)) for output in follows]))
    more = every[-1] - few
    rows = schema.scaler.restore(anchors)[:, inputs]
    usual = np.sqrt(np.mean((rows @ more[:-1] + more[-1]) ** 2, axis=0))
    return Line(inputs, outputs, few, more, usual, every[:-1])
