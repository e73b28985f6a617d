"""Renewal of the certainty of estimates on samples of the body as it is.

The expected errors of a schema follow the samples (`gemuco.adaption.seen`). They were measured where these samples are,
so the factor of a sample counts relative to the factors of the samples seen, and values that were seen are no longer
outside of what is known.
"""

from dataclasses import replace

import numpy as np

from gemuco.adaption.innovation import own_bias
from gemuco.certainty import Certainty
from gemuco.compiled.certainty import novelties
from gemuco.masks import Mask
from gemuco.schema import BodySchema

FOLLOW = 0.2
"""A range, a cap or a limit goes this share of the way to a sample beyond it: a single outlier moves it little."""


class Renewal:
    """A certainty that follows samples of the body, each measured before it is learned from.

    Args:
        schema: The schema to begin with.
    """

    def __init__(self, schema: BodySchema) -> None:
        self._first = certainty = schema.certainty
        if certainty is None:
            return
        self._low, self._high = certainty.low.copy(), certainty.high.copy()
        self._logs, self._limits = certainty.logs.copy(), certainty.limits.copy()
        self._factors = np.exp(-2.0 * certainty.slopes[:, :, 0])
        """This holds the mean square of the factor of the samples, per way and element, shape (ways, size)."""
        self._seen: dict[int, bool] = {}

    def see(self, schema: BodySchema, x: np.ndarray, mask: Mask, squared: np.ndarray, share: float) -> None:
        """Take a sample that covers a mask.

        Args:
            schema: The schema in use.
            x: The sample [standard deviations], shape (size,).
            mask: The mask.
            squared: Squared errors of the network under this mask [standard deviations squared], shape (out_size,).
            share: Share of the sample in the means.
        """
        certainty = self._first
        if certainty is None or (place := certainty.place(("mask", mask))) is None:
            return
        elements = given_elements(schema, mask, np.isfinite(x))
        z = (self._measures(schema, certainty, x, elements, squared) - self._logs[place, :, 0]) / self._logs[
            place, :, 1
        ]
        capped = np.clip(z, self._logs[place, :, 2], self._logs[place, :, 3])
        factor = np.exp(2.0 * certainty.slopes[place, :, 1:] @ capped)
        self._factors[place] += share * (factor - self._factors[place])
        self._logs[place, :, 3] += FOLLOW * np.maximum(z - self._logs[place, :, 3], 0.0)
        length = float(np.sqrt((z[:3].clip(min=0.0) ** 2).sum()))
        self._limits[place] += FOLLOW * np.maximum(length - self._limits[place], 0.0)
        low, high = self._low[elements], self._high[elements]
        self._low[elements] += FOLLOW * np.minimum(x[elements] - low, 0.0)
        self._high[elements] += FOLLOW * np.maximum(x[elements] - high, 0.0)
        self._seen[place] = True

    @staticmethod
    def _measures(
        schema: BodySchema, certainty: Certainty, x: np.ndarray, elements: np.ndarray, squared: np.ndarray
    ) -> np.ndarray:
        given = np.isin(schema.out_index, elements) & np.isfinite(squared)
        residual = float(np.sqrt(squared[given].mean())) if given.any() else float("nan")
        reach = certainty.reach(schema.anchors, elements)
        ranges = np.ascontiguousarray(np.stack([certainty.low, certainty.high])[:, elements])
        own = standard_p(schema, own_bias(schema, len(schema.anchors)))
        own = own - standard_p(schema, schema.bias[None])
        nearest = (own**2).sum(axis=1).min() if len(own) else 0.0
        extra = np.sqrt(((own**2).sum(axis=1) - nearest).clip(min=0.0))[:, None]
        parts = (reach.anchors, extra, reach.precision, elements, ranges, np.ascontiguousarray(x, float)[None])
        measures: np.ndarray = novelties(*parts, np.zeros((1, 1)), np.array([residual]))[0]
        return measures

    def certainty(self) -> Certainty | None:
        """Return the certainty as it is now."""
        first = self._first
        if first is None:
            return None
        slopes = first.slopes.copy()
        for place in self._seen:
            slopes[place, :, 0] = -0.5 * np.log(self._factors[place])
        return replace(
            first, low=self._low.copy(), high=self._high.copy(), logs=self._logs.copy(), limits=self._limits.copy(),
            slopes=slopes,
        )  # fmt: skip


def given_elements(schema: BodySchema, mask: Mask, finite: np.ndarray) -> np.ndarray:
    """Return the positions of the given elements of a way, without dead ones, shape (n,)."""
    inside = np.zeros(schema.layout.size, bool)
    inside[schema.layout.indices(mask)] = True
    inside[schema.scaler.dead] = False
    return np.flatnonzero(inside & finite)


def standard_p(schema: BodySchema, p: np.ndarray) -> np.ndarray:
    """Return p in standard deviations of the trained ones, shape (n, bias_size); 0 with less than two conditions."""
    if len(schema.biases) < 2 or not len(schema.bias):
        return np.zeros(p.shape)
    known = np.stack(list(schema.biases.values())).astype(float)
    return np.asarray((p - known.mean(axis=0)) / (known.std(axis=0) + 1e-6))
