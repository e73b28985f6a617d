"""Estimates beyond what was learned: an output that is linear within it follows the linear path alone.

The network's correction of such an output is a detail of the learned samples. Beyond them it is arbitrary. So are the
weights of inputs that only went together in these samples, and the path is that of as few inputs as do no harm. Where
the body is not linear the network is better there too.
"""

from typing import NamedTuple

import numpy as np

from gemuco.adaption.innovation import own_bias
from gemuco.masks import Mask
from gemuco.schema import BodySchema

LINEAR = 0.05
"""An output is linear if the network's correction of the linear path, root mean square over the anchors, is below this
many standard deviations: the path explains 99.75 % of its variance."""


class Line(NamedTuple):
    """The linear path of the outputs that are linear under a mask.

    Attributes:
        inputs: Indices in the layout of the elements that the mask lets through, shape (n,).
        outputs: Indices in the layout of the outputs, shape (k,).
        matrix: The outputs [unit] by the inputs [unit] and 1, shape (n + 1, k).
    """

    inputs: np.ndarray
    outputs: np.ndarray
    matrix: np.ndarray

    def take_over(self, joined: np.ndarray, inside: float, missing: np.ndarray, value: np.ndarray) -> None:
        """Mix the path into the estimates of the missing outputs.

        Args:
            joined: Every element of the layout [its unit], shape (size,).
            inside: Share of the estimate as it is; the rest is the path.
            missing: Whether each element is estimated, truth values, shape (size,).
            value: Every element [its unit], shape (size,); the estimates are changed in place.
        """
        straight = joined[self.inputs] @ self.matrix[:-1] + self.matrix[-1]
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
    few = np.stack([schema.path.by_few(through, int(output)) for output in follows], axis=1)
    outputs = schema.out_index[follows]
    matrix = few[np.append(through, True)] * std[outputs]
    matrix[:-1] /= std[inputs][:, None]
    matrix[-1] += mean[outputs] - mean[inputs] @ matrix[:-1]
    return Line(inputs, outputs, matrix)
