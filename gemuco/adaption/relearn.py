"""Gradient steps on W, on p, or on both (paper, usages (c) and (d)), with replay and rollback."""

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.innovation import own_bias
from gemuco.adaption.recognise import Prior
from gemuco.compiled.batch import under_masks
from gemuco.compiled.chain import pack, unpack
from gemuco.compiled.learning import SQUARED, gradients, loss
from gemuco.optimiser import Optimiser
from gemuco.schema import BodySchema, stacked

JUDGED = 60
"""W is judged by at most this many of the newest held-out samples."""
JUDGE_EVERY = 5
"""W is judged at every call of `step` whose number is a multiple of this."""
RECOVERY = 1.2
"""The learning rate, once halved, grows by this factor with every better W."""
WORSE = 1.1
"""W goes back when its held-out squared error exceeds that of the best W so far by this factor."""


class Window:
    """Samples [standard deviations] in a ring: the oldest are replaced, and every k-th is held out.

    Args:
        size: Maximum number of samples.
        width: Elements of a sample.
        held_out: k; 0 holds none out.
    """

    def __init__(self, size: int, width: int, held_out: int) -> None:
        self._rows = np.full((size, width), np.nan, np.float32)
        self._serial = np.full(size, -1)
        self._held_out = held_out
        self._learned: np.ndarray | None = None
        self.added = 0
        self.dropped = 0

    def __len__(self) -> int:
        """Return the number of samples in the window."""
        return int((self._serial >= 0).sum())

    def add(self, row: np.ndarray) -> None:
        """Put a sample in, shape (width,), in place of the oldest if the window is full."""
        slot = self.added % len(self._rows)
        self.dropped += bool(self._serial[slot] >= 0)
        self._rows[slot] = row
        self._serial[slot] = self.added
        self.added += 1
        self._learned = None

    def forget_before(self, serial: int) -> None:
        """Drop the samples before the one with a number; the first sample has number 0."""
        old = (self._serial >= 0) & (self._serial < serial)
        self.dropped += int(old.sum())
        self._serial[old] = -1
        self._learned = None

    def learned(self) -> np.ndarray:
        """Return the samples to learn from, shape (n, width), in no particular order."""
        if self._learned is None:
            kept = self._serial >= 0
            self._learned = self._rows[kept & ~self._held()] if self._held_out else self._rows[kept]
        return self._learned

    def held(self, most: int) -> np.ndarray:
        """Return at most this many of the newest held-out samples, newest first, shape (n, width)."""
        if not self._held_out:
            return self._rows[:0]
        return self._newest((self._serial >= 0) & self._held(), most)

    def newest(self, most: int) -> np.ndarray:
        """Return at most this many of the newest samples, newest first, shape (n, width)."""
        return self._newest(self._serial >= 0, most)

    def _held(self) -> np.ndarray:
        return self._serial % self._held_out == self._held_out - 1

    def _newest(self, chosen: np.ndarray, most: int) -> np.ndarray:
        index = np.flatnonzero(chosen)
        return self._rows[index[np.argsort(self._serial[index])[::-1][:most]]]


class Relearner:
    """A learner from a window, from constraints and from the training data of other conditions.

    Every `held_out`-th sample only judges. W goes back to the best one so far when its error on those samples grows,
    and the learning rate is halved until the error falls again.

    Args:
        schema: The schema to begin with.
        config: Settings of the update.
        constraints: Samples that never grow old [standard deviations], shape (n, size).

    Attributes:
        window: Samples of the body.
        held_out: Mean squared error on held-out samples when last judged; NaN before.
        rolled_back: Number of times W went back.
    """

    def __init__(self, schema: BodySchema, config: UpdateConfig, constraints: np.ndarray) -> None:
        self.window = Window(config.window, schema.layout.size, config.held_out)
        self.rolled_back = 0
        self._config, self._constraints = config, constraints
        self._random = np.random.default_rng(config.seed)
        self.restart(schema)

    def restart(self, schema: BodySchema) -> None:
        """Forget momentum and judgements, and continue from the W and p of a schema."""
        config = self._config
        self._chain = pack(schema.weights.whole)
        self._bias = schema.bias.copy()
        self._optimiser = Optimiser(config.optimiser, config.rate, len(self._chain.flat))
        self._bias_optimiser = Optimiser(config.optimiser, config.bias_rate, len(self._bias))
        self._best = schema.weights
        self._gates = gates(schema)
        self._anchors, self._anchor_biases = _others(schema)
        self._calls = 0
        self.held_out = float("nan")

    def step(self, schema: BodySchema, weights: bool, bias: bool) -> tuple[BodySchema, float]:
        """Take a few gradient steps.

        Args:
            schema: The schema in use, with its p.
            weights: Whether W moves.
            bias: Whether p moves.

        Returns:
            The schema after the steps, and the mean squared error of the first batch before them; the unchanged schema
            and infinity if a step led to an infinite number.
        """
        self._bias[:] = schema.bias
        first = float("nan")
        for index in range(self._config.steps):
            loss = self._descend(schema, weights, bias)
            first = loss if index == 0 else first
        if not (np.isfinite(self._chain.flat).all() and np.isfinite(self._bias).all()):
            self.restart(schema)
            return schema, float("inf")
        if bias:
            schema = schema.with_bias(self._bias)
        if weights:
            schema = self._judge(schema.with_weights(schema.weights.replaced(unpack(self._chain))))
        return schema, first

    def _descend(self, schema: BodySchema, weights: bool, bias: bool) -> float:
        """Take one gradient step in place and return the loss before it."""
        inputs, outputs, present = self._batch(schema)
        loss, by_weights, by_input = gradients(self._chain, inputs, outputs, SQUARED, weights, bias)
        if weights:
            self._optimiser.move(self._chain.flat, by_weights)
        if bias:
            self._bias_optimiser.move(self._bias, by_input[present, -len(self._bias) :].sum(axis=0))
        return float(loss)

    def _batch(self, schema: BodySchema) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw samples, each under every mask it covers.

        Returns:
            Inputs (rows, inputs), measured x_out (rows, out_size), and whether rows are of the present body (rows,).
        """
        config = self._config
        samples = self.window.learned()
        if len(self._constraints):
            samples = np.concatenate([samples, self._constraints])
        old = config.replay if len(self._anchors) else 0
        drawn = self._random.random(config.batch) * (len(samples) + old)
        now = samples[drawn[drawn < len(samples)].astype(int)]
        replayed = self._random.integers(0, max(1, len(self._anchors)), config.batch - len(now))
        rows, biases = now, np.repeat(self._bias[None], len(now), axis=0)
        if old:
            rows = np.concatenate([rows, self._anchors[replayed]])
            biases = np.concatenate([biases, self._anchor_biases[replayed]])
        inputs, outputs, origin = under_masks(_plain(rows), _plain(biases), *self._gates, schema.predictor)
        return inputs, outputs, origin < len(now)

    def _judge(self, schema: BodySchema) -> BodySchema:
        """Return the schema, or the best W so far if the new one is worse on held-out samples."""
        self._calls += 1
        rows = self.window.held(JUDGED)
        if self._calls % JUDGE_EVERY or not len(rows):
            return schema
        self.held_out = mean_error(schema, rows)
        best = schema.with_weights(self._best)
        before = mean_error(best, rows)
        if self.held_out <= before:
            self._best = schema.weights
            self._optimiser.rate = min(self._config.rate, RECOVERY * self._optimiser.rate)
        elif self.held_out > WORSE * before:
            rate = 0.5 * self._optimiser.rate
            self._chain = pack(self._best.whole)
            self._optimiser = Optimiser(self._config.optimiser, rate, len(self._chain.flat))
            self.held_out = before
            self.rolled_back += 1
            return best
        return schema


def mean_error(schema: BodySchema, rows: np.ndarray) -> float:
    """Return the mean squared error of samples under all masks they cover [standard deviations squared]."""
    biases = np.repeat(schema.bias[None], len(rows), axis=0)
    inputs, outputs, _ = under_masks(_plain(rows), _plain(biases), *gates(schema), schema.predictor)
    return float(loss(schema.predictor.chain, inputs, outputs, SQUARED))


def _plain(rows: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(rows, np.float32)


def gates(schema: BodySchema) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `through`, `line` and m of every mask; see `Gate`."""
    through, paths, tails = stacked(schema, schema.masks)
    return through, paths, np.ascontiguousarray(tails[:, : len(schema.x_in)])


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
