"""The region of some signals in which the body is known."""

from typing import Any

import numpy as np

from gemuco.intervals.sureness import MARGIN, SURE, UNKNOWN, Sureness
from gemuco.schema import BodySchema

RANK, NEARLY_ALL = 10, 0.995
"""A value is outside if it is further from its nearest anchor than nearly all anchors are from their tenth nearest: the
nearest ones may be of the same motion, right before and after, and say nothing of the distance between motions."""


class Region:
    """The learned values of one signal, by its ranges and by the anchors of a schema.

    Args:
        schema: The body schema. Without anchors only the ranges count.
        name: The signal.
    """

    def __init__(self, schema: BodySchema, name: str) -> None:
        self._span, self._name, self._layout = schema.layout.slice(name), name, schema.layout
        scaler = schema.scaler
        self._mean, self._std = scaler.mean[self._span], scaler.std[self._span]
        anchors = schema.anchors[:, self._span].astype(float) if len(schema.anchors) else np.zeros((0, len(self._std)))
        edges = np.stack([scaler.low[self._span], scaler.high[self._span]])
        certainty = schema.certainty
        if certainty is not None:
            edges = np.stack([certainty.low[self._span], certainty.high[self._span]]) * self._std + self._mean
        known: dict[Any, Any] = {} if certainty is None else certainty.known
        if ("region", name) not in known:
            known["region", name] = _limit(anchors)
        self._edges, self._anchors, self._limit = edges, anchors, known["region", name]

    def judge(self, values: np.ndarray) -> Sureness:
        """Return whether the body is known at some values [the signal's unit], shape (n,)."""
        low, high = self._edges
        over = np.maximum(low - values, values - high) - MARGIN * (high - low)
        k = int(over.argmax())
        if over[k] > 0.0:
            edge, word = (high[k], "to") if values[k] > high[k] else (low[k], "from")
            element, unit = self._layout.element(self._span.start + k), self._layout.signal(self._name).unit
            text = f"outside of the range of {element}: {values[k]:.4g} {unit}, learned {word} {edge:.4g} {unit}"
            return Sureness(UNKNOWN, text)
        x = (values - self._mean) / self._std
        if len(self._anchors) and float(((self._anchors - x) ** 2).sum(axis=1).min()) > self._limit**2:
            return Sureness(UNKNOWN, f"this {self._name} is far from all learned ones")
        return SURE


def _limit(anchors: np.ndarray) -> float:
    """Return the largest usual distance of a value from its nearest anchor [standard deviations]."""
    if len(anchors) < 2:
        return float("inf")
    squared = (anchors**2).sum(axis=1)
    between = squared[:, None] + squared - 2.0 * anchors @ anchors.T
    rank = min(RANK, len(anchors) - 1)  # each is nearest to itself
    near = np.partition(between, rank, axis=1)[:, rank].clip(min=0.0)
    return float(np.quantile(np.sqrt(near), NEARLY_ALL))


def learned_range(schema: BodySchema) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest value of every element up to which its relations are known, shapes (size,).

    They are [standard deviations] those of the training data and of the update, with a margin, or those of the normal
    samples, whichever reach further.
    """
    low, high = schema.scaler.normalise(np.stack([schema.scaler.low, schema.scaler.high]))
    if schema.certainty is not None:
        low, high = schema.certainty.low, schema.certainty.high
    room = MARGIN * (high - low)
    low, high = low - room, high + room
    if schema.normal is not None and len(schema.normal.rows):
        rows = schema.normal.rows[:, : schema.layout.size]
        low, high = np.fmin(low, np.fmin.reduce(rows)), np.fmax(high, np.fmax.reduce(rows))
    return low, high
