"""The std and the state of the estimates of one sample, made in one way."""

import math
from typing import NamedTuple

import numpy as np

from gemuco.adaption.innovation import own_bias
from gemuco.adaption.recognise import NARROW, Prior
from gemuco.adaption.renewal import given_elements, standard_p
from gemuco.adaption.seen import EXPLAINED
from gemuco.certainty.certainty import Certainty, Way
from gemuco.compiled.certainty import spread
from gemuco.masks import Mask
from gemuco.schema import BodySchema
from gemuco.signals import Layout

KNOWN, DOUBTFUL, UNKNOWN = "known", "doubtful", "unknown"
"""The states of an estimate, from the best to the worst."""
STATES = (KNOWN, DOUBTFUL, UNKNOWN)
"""The states in this order."""
MARGIN = 0.03
"""A value further outside of its learned range than this share of the range is outside."""
OTHER_P = 0.3
"""A p further than this from all trained ones is of no known condition [standard deviations of the trained p]."""
SAMPLED = 48
"""The slope of the estimates by p is a mean over this many anchors."""
STEP = 1e-2
"""Its finite differences have this width [standard deviations of the trained p]."""
WORDS = (
    "the given values are further from all learned samples than learned samples are from each other",
    "the given values are outside of the relations that were learned",
    "the given values do not fit each other as in the learned samples",
)
"""These are the reasons of the first three measures of `gemuco.compiled.certainty.novelty`."""


class Sureness(NamedTuple):
    """State of an estimate.

    Attributes:
        state: `known`, `doubtful` or `unknown`.
        reason: One sentence; empty if it is known.
    """

    state: str
    reason: str


SURE = Sureness(KNOWN, "")
"""This is the state of a measured value."""


class Judgement(NamedTuple):
    """Judgement of the estimates of one sample.

    Attributes:
        sureness: Their state.
        inside: 1 unless the state is unknown because the sample is outside of what was learned; then it falls with
            the distance from there to 0.
    """

    sureness: Sureness
    inside: float


def worse(one: Sureness, other: Sureness) -> Sureness:
    """Return the worse of two states, the first if they are equal."""
    return one if STATES.index(one.state) >= STATES.index(other.state) else other


def since_change(schema: BodySchema, missing: np.ndarray) -> Sureness:
    """Return the state of an estimate of missing elements, truth values, shape (size,), on a body that changed."""
    unseen = None if schema.certainty is None else schema.certainty.unseen
    if unseen is None or not (unseen & missing).any():
        return SURE
    name = schema.layout.element(int(np.flatnonzero(unseen & missing)[0]))
    return Sureness(DOUBTFUL, f"the body changed, and {name} was not measured since")


class Judge:
    """The std and the state of estimates in one way, for samples with the same given elements.

    Args:
        schema: A schema with a certainty.
        way: Method and given signals.
        finite: Whether each element of the layout is given, shape (size,).
        expected: Expected error of every element [unit], shape (size,).
        tried: Number of samples on which a way that was not calibrated was tried.
    """

    def __init__(self, schema: BodySchema, way: Way, finite: np.ndarray, expected: np.ndarray, tried: int = 0) -> None:
        certainty, std = schema.certainty, schema.scaler.std
        assert certainty is not None
        place = certainty.place(way)
        self._layout, self._way, self._tried = schema.layout, way, tried
        self.is_calibrated = place is not None
        self.about_p = about_p(schema)
        elements = given_elements(schema, way[1], finite)
        self._elements = elements
        reach = certainty.reach(schema.anchors, elements)
        ranges = schema.scaler.restore(np.stack([certainty.low, certainty.high]))
        variance = _variance_of_p(schema, certainty, way)
        if place is None:
            logs, slopes = np.tile([0.0, 1e9, 0.0, 0.0], (4, 1)), np.zeros((schema.layout.size, 5))
            knots, growth = np.ones(1), np.zeros((1, schema.layout.size))
            self._limits = np.full(2, np.inf)
        else:
            logs, slopes = certainty.logs[place].copy(), certainty.slopes[place].copy()  # those of a file are read-only
            knots, growth = certainty.knots[place].copy(), certainty.growth[place] * std**2
            self._limits = certainty.limits[place]
        self._ranges = np.ascontiguousarray(ranges[:, elements])
        self._parts = (
            reach.anchors, _offsets(schema), reach.precision, elements, logs, self._ranges, slopes,
            np.asarray(expected, float), variance, knots, growth, np.stack([schema.scaler.mean, std]),
        )  # fmt: skip

    def judge(self, joined: np.ndarray, residual: float, requested: np.ndarray, std: np.ndarray) -> Judgement:
        """Write the std of the requested elements, and return their state and whether the sample is as learned.

        Args:
            joined: Every element of the layout [its unit], shape (size,).
            residual: Error of the network on the given values [standard deviations]; NaN if it predicts none of them.
            requested: Whether each element is requested, truth values, shape (size,).
            std: Result for the requested elements [unit], shape (size,).
        """
        far, odd, unfit, _, _, worst, over = spread(*self._parts, joined, residual, requested, std).tolist()
        measures = [max(far, 0.0), max(odd, 0.0), max(unfit, 0.0)]
        length = math.hypot(*measures)
        inside = min(_fades(over, MARGIN), _fades(length, float(self._limits[1])))
        return Judgement(self._sureness(measures, length, int(worst), over, joined), inside)

    def _sureness(self, measures: list[float], length: float, worst: int, over: float, joined: np.ndarray) -> Sureness:
        if over > MARGIN:
            edges = tuple(self._ranges[:, worst].tolist())
            return Sureness(UNKNOWN, _range_text(self._layout, int(self._elements[worst]), joined, edges))
        if length > self._limits[0]:
            state = UNKNOWN if length > self._limits[1] else DOUBTFUL
            return worse(Sureness(state, WORDS[measures.index(max(measures))]), self.about_p)
        if not self.is_calibrated:
            way = f"how exact an estimate by {self._way[0]} from these signals is was"
            tried = Sureness(DOUBTFUL, f"{way} measured on {self._tried} samples only")
            return worse(self.about_p, tried if self._tried else Sureness(UNKNOWN, f"{way} never measured"))
        return self.about_p


class RangeJudge:
    """The state of estimates of a model without certainty: whether all given values are as in its data.

    Args:
        schema: The body schema.
        mask: The given signals.
        finite: Whether each element of the layout is given, shape (size,).
    """

    def __init__(self, schema: BodySchema, mask: Mask, finite: np.ndarray) -> None:
        self._layout, self._elements = schema.layout, given_elements(schema, mask, finite)
        self._low, self._high = schema.scaler.low[self._elements], schema.scaler.high[self._elements]
        self._room = MARGIN * (self._high - self._low)

    def judge(self, joined: np.ndarray, residual: float, requested: np.ndarray, std: np.ndarray) -> Judgement:
        """Return the judgement; the arguments are those of `Judge.judge`, and the std is not changed."""
        values = joined[self._elements]
        over = np.maximum(self._low - values, values - self._high) - self._room
        if not len(over) or over[worst := int(over.argmax())] <= 0.0:
            return Judgement(SURE, 1.0)
        edges = float(self._low[worst]), float(self._high[worst])
        sureness = Sureness(UNKNOWN, _range_text(self._layout, int(self._elements[worst]), joined, edges))
        return Judgement(sureness, _fades(float(over[worst] / max(self._room[worst], 1e-12)) + 1.0, 1.0))


def _fades(distance: float, limit: float) -> float:
    """Return 1 up to a limit, 0 from twice the limit on, and the straight line between them."""
    return 1.0 if distance <= limit else max(0.0, 2.0 - distance / limit)


def _range_text(layout: Layout, element: int, joined: np.ndarray, edges: tuple[float, float]) -> str:
    low, high = edges
    value, name = joined[element], layout.element(element)
    edge, word = (high, "to") if value > high else (low, "from")
    unit = layout.signal(name.split(".")[0]).unit
    return f"outside of the range of {name}: {value:.4g} {unit}, learned {word} {edge:.4g} {unit}"


def _offsets(schema: BodySchema) -> np.ndarray:
    """Return the squared distance of p from that of every anchor, less the smallest, shape (anchors,), float32.

    A p of no known condition is judged by itself (`about_p`); the sample is compared with the nearest conditions.
    """
    of_anchors = standard_p(schema, own_bias(schema, len(schema.anchors)))
    squared = ((of_anchors - standard_p(schema, schema.bias[None])) ** 2).sum(axis=1)
    return np.asarray(squared - squared.min(initial=np.inf), np.float32)


def about_p(schema: BodySchema) -> Sureness:
    """Return the state of the present p: whether it is like a trained one.

    A p that was recognised from samples may lie between the trained ones. Beyond them it is doubtful, and unknown if it
    does not explain the samples either. One that was not recognised, such as the mean of the trained ones, is doubtful,
    or unknown beyond them.
    """
    if len(schema.biases) < 2 or not len(schema.bias):
        return SURE
    prior, p = Prior.of(schema), schema.bias.astype(float)
    certainty = schema.certainty
    distances = [prior.between(p, known) for known in prior.known]
    nearest = int(np.argmin(distances))
    is_beyond = distances[nearest] > max(OTHER_P, prior.gap)
    if certainty is not None and certainty.covariance is not None:
        is_wrong = certainty.excess > EXPLAINED
        if is_beyond:
            return _of_no_condition(schema, nearest, distances[nearest], UNKNOWN if is_wrong else DOUBTFUL)
        text = f"no p explains what is seen: the errors are {certainty.excess:.1f} times as large as learned"
        return Sureness(DOUBTFUL, text) if is_wrong else SURE
    if distances[nearest] <= OTHER_P:
        return SURE
    return _of_no_condition(schema, nearest, distances[nearest], UNKNOWN if is_beyond else DOUBTFUL)


def _of_no_condition(schema: BodySchema, nearest: int, distance: float, state: str) -> Sureness:
    name = list(schema.biases)[nearest]
    text = f"p is of no known condition; the nearest, '{name}', is {distance:.1f} standard deviations away"
    return Sureness(state, text)


def _variance_of_p(schema: BodySchema, certainty: Certainty, way: Way) -> np.ndarray:
    """Return the variance of every element that comes from an uncertain p [unit squared], shape (size,).

    A p that was not recognised is as uncertain as it is far from the nearest trained one; one that was, as it is beyond
    the trained ones.
    """
    variance = np.zeros(schema.layout.size)
    if len(schema.biases) < 2 or not len(schema.bias) or not schema.masks:
        return variance
    covariance, prior, p = certainty.covariance, Prior.of(schema), schema.bias.astype(float)
    if covariance is not None:  # beyond the trained ones the network is wrong even with the best p
        covariance = covariance + prior.beyond(p) ** 2 * prior.covariance
    else:
        away = min(prior.between(p, known) for known in prior.known)
        if away <= NARROW:
            return variance
        covariance = away**2 * prior.covariance
    mask = way[1] if way[0] == "mask" else schema.masks[0]
    products = _products(schema, certainty, mask)
    variance[schema.out_index] = np.einsum("ijk,jk->i", products, covariance).clip(min=0.0)
    return np.asarray(variance * schema.scaler.std**2)


def _products(schema: BodySchema, certainty: Certainty, mask: Mask) -> np.ndarray:
    """Return the mean product of the slopes of every x_out by two elements of p, shape (out_size, b, b)."""
    kept = certainty.known.get(("p", mask))
    if kept is not None and kept[0] is schema.weights:
        return np.asarray(kept[1])
    count = min(SAMPLED, len(schema.anchors))
    chosen = np.linspace(0, len(schema.anchors) - 1, count).astype(int)
    x = schema.anchors[chosen].astype(float)
    p = own_bias(schema, len(schema.anchors))[chosen].astype(float)
    width = STEP * np.sqrt(np.diag(Prior.of(schema).covariance))
    slopes = []
    for k in range(len(schema.bias)):
        step = np.zeros(len(schema.bias))
        step[k] = width[k]
        both = [schema.infer(x, mask, p + sign * step) for sign in (1.0, -1.0)]
        slopes.append((both[0].astype(float) - both[1]) / (2.0 * width[k]))
    slope = np.stack(slopes, axis=2)  # (anchors, out_size, b)
    products = np.einsum("aij,aik->ijk", slope, slope) / max(count, 1)
    certainty.known["p", mask] = schema.weights, products
    return np.asarray(products)
