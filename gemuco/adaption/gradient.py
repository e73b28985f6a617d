"""Gradient steps on W, on p, or on both (paper, usages (c) and (d)), with replay of the training data."""

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.innovation import own_bias
from gemuco.adaption.recognise import Prior
from gemuco.compiled.batch import under_masks
from gemuco.compiled.chain import pack, unpack
from gemuco.compiled.learning import SQUARED, gradients, loss
from gemuco.optimiser import Optimiser
from gemuco.schema import BodySchema, stacked

AVERAGED = 0.02
"""The newest W has at least this share in the mean of W."""


class GradientSteps:
    """Gradient descent of a copy of W and p, on samples of the body and on training data of the other conditions.

    Args:
        schema: The schema to begin with.
        config: Settings of the update.
        random: Source of chance.

    Attributes:
        bias: p, shape (bias_size,).
    """

    def __init__(self, schema: BodySchema, config: UpdateConfig, random: np.random.Generator) -> None:
        self.bias = schema.bias.copy()
        self._config, self._random = config, random
        self._gates = gates(schema)
        self._anchors, self._anchor_biases = _others(schema)
        self._bias_optimiser = Optimiser(config.optimiser, config.bias_rate, len(self.bias))
        self.begin(schema, config.rate)

    def begin(self, schema: BodySchema, rate: float) -> None:
        """Continue from the W of a schema at a learning rate, without momentum."""
        self._chain = pack(schema.weights.whole)
        self._mean, self._taken = self._chain.flat.copy(), 0
        self.optimiser = Optimiser(self._config.optimiser, rate, len(self._chain.flat))

    def take(self, count: int, schema: BodySchema, rows: np.ndarray, weights: bool, bias: bool) -> float:
        """Take steps in place.

        Args:
            count: Number of steps.
            schema: The schema in use.
            rows: Samples of the body [standard deviations], shape (n, size), float32.
            weights: Whether W moves.
            bias: Whether p moves.

        Returns:
            The mean squared error of the first batch before the first step.
        """
        first = float("nan")
        for index in range(count):
            inputs, targets, counts, present = self._batch(schema, rows)
            before, by_weights, by_input = gradients(self._chain, inputs, targets, counts, SQUARED, weights, bias)
            if weights:
                self.optimiser.move(self._chain.flat, by_weights)
                self._taken += 1
                self._mean += max(AVERAGED, 3.0 / (self._taken + 2)) * (self._chain.flat - self._mean)
            if bias:
                self._bias_optimiser.move(self.bias, by_input[present, -len(self.bias) :].sum(axis=0))
            first = float(before) if index == 0 else first
        return first

    @property
    def is_finite(self) -> bool:
        """Whether every number of W and p is finite."""
        return bool(np.isfinite(self._chain.flat).all() and np.isfinite(self.bias).all())

    def result(self, schema: BodySchema, weights: bool, bias: bool) -> BodySchema:
        """Return a schema with the W and the p of these steps, as far as they moved."""
        if bias:
            schema = schema.with_bias(self.bias)
        return (
            schema.with_weights(schema.weights.replaced(unpack(self._chain._replace(flat=self._mean))))
            if weights
            else schema
        )

    def _batch(self, schema: BodySchema, samples: np.ndarray) -> tuple[np.ndarray, ...]:
        """Draw samples, each under every mask it covers.

        Returns:
            Inputs (rows, inputs), targets and their weights (rows, out_size) of `under_masks`, and whether a row is of
            the present body (rows,).
        """
        config = self._config
        old = config.replay if len(self._anchors) else 0
        drawn = self._random.random(config.batch) * (len(samples) + old)
        now = samples[drawn[drawn < len(samples)].astype(int)]
        replayed = self._random.integers(0, max(1, len(self._anchors)), config.batch - len(now))
        rows, biases = now, np.repeat(self.bias[None], len(now), axis=0)
        if old:
            rows = np.concatenate([rows, self._anchors[replayed]])
            biases = np.concatenate([biases, self._anchor_biases[replayed]])
        inputs, targets, counts, origin = under_masks(_plain(rows), _plain(biases), *self._gates, schema.predictor)
        return inputs, targets, counts, origin < len(now)


def mean_error(schema: BodySchema, rows: np.ndarray) -> float:
    """Return the mean squared error of samples under all masks they cover [standard deviations squared].

    Only elements in which the network has a share count: W does not change the others.
    """
    biases = np.repeat(schema.bias[None], len(rows), axis=0)
    inputs, targets, counts, _ = under_masks(_plain(rows), _plain(biases), *gates(schema), schema.predictor)
    return float(loss(schema.predictor.chain, inputs, targets, counts, SQUARED))


def _plain(rows: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(rows, np.float32)


def gates(schema: BodySchema) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return `through`, `line`, m and `direct` of every mask; see `Gate`."""
    through, paths, tails, directs = stacked(schema, schema.masks)
    return through, paths, np.ascontiguousarray(tails[:, : len(schema.x_in)]), directs


def _others(schema: BodySchema) -> tuple[np.ndarray, np.ndarray]:
    """Return the anchors of conditions other than the present one, and the p of each.

    A trained condition is the present one if p is nearer to it than half the distance to its nearest neighbour: its old
    samples must not hold back the new ones. Without parametric bias all anchors count.
    """
    anchors = schema.anchors
    biases = own_bias(schema, len(anchors))
    known = np.array(list(schema.biases.values()))
    if not len(anchors) or len(known) < 2 or len(schema.anchor_conditions) != len(anchors):
        return anchors, biases
    prior = Prior.of(schema)
    distances = [prior.between(schema.bias, p) for p in known]
    nearest = int(np.argmin(distances))
    apart = min(prior.between(known[nearest], p) for i, p in enumerate(known) if i != nearest)
    if distances[nearest] > 0.5 * apart:
        return anchors, biases
    others = schema.anchor_conditions != nearest
    return anchors[others], biases[others]
