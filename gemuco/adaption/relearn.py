"""The slow update of W and p from a window of samples (paper, usages (c) and (d)), with replay and rollback."""

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.gradient import GradientSteps, mean_error
from gemuco.adaption.window import Window
from gemuco.schema import BodySchema

JUDGED = 60
"""W is judged by at most this many of the newest held-out samples."""
JUDGE_EVERY = 15
"""W is judged after every series of this many gradient steps."""
RECOVERY = 1.2
"""The learning rate, once halved, grows by this factor with every better W."""
WORSE = 1.1
"""W goes back when its held-out squared error exceeds that of the best W so far by this factor."""


class Relearner:
    """A learner from a window, from constraints and from the training data of other conditions.

    One of `held_out` samples only judges. W goes back to the best one so far when its error on those samples grows, and
    the learning rate is halved until the error falls again.

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
        self.window = Window(config.window, schema.layout.size, config.held_out, JUDGED)
        self.rolled_back = 0
        self._config, self._constraints = config, constraints
        self._random = np.random.default_rng(config.seed)
        self.restart(schema)

    def restart(self, schema: BodySchema) -> None:
        """Forget momentum and judgements, and continue from the W and p of a schema."""
        self._steps = GradientSteps(schema, self._config, self._random)
        self._best = schema.weights
        self._unjudged = 0
        self.held_out = float("nan")

    def step(self, schema: BodySchema, count: int, weights: bool, bias: bool) -> tuple[BodySchema, float, int]:
        """Take gradient steps, fewer if W goes back.

        Args:
            schema: The schema in use, with its p.
            count: Number of steps.
            weights: Whether W moves.
            bias: Whether p moves.

        Returns:
            The schema after the steps, the mean squared error of the first batch before them, and their number; the
            best W so far, the unchanged p and infinity if a step led to an infinite number.
        """
        self._steps.bias[:] = schema.bias
        samples, unchanged = self.window.learned(), schema
        if len(self._constraints):
            samples = np.concatenate([samples, self._constraints])
        if not len(samples):
            return schema, float("nan"), 0
        first, taken, before = float("nan"), 0, self.rolled_back
        while taken < count and self.rolled_back == before:
            part = min(count - taken, JUDGE_EVERY - self._unjudged)
            loss = self._steps.take(part, schema, samples, weights, bias)
            first, taken = (loss if taken == 0 else first), taken + part
            if not self._steps.is_finite:
                schema = unchanged.with_weights(self._best)
                self._go_back(schema)
                return schema, float("inf"), taken
            self._unjudged += part
            if self._unjudged == JUDGE_EVERY:
                self._unjudged = 0
                schema = self._steps.result(schema, weights, bias)
                schema = self._judge(schema) if weights else schema
        return (self._steps.result(schema, weights, bias) if self._unjudged else schema), first, taken

    def _judge(self, schema: BodySchema) -> BodySchema:
        """Return the schema, or the best W so far if the new one is worse on held-out samples."""
        rows = self.window.held()
        if not len(rows):
            return schema
        self.held_out = mean_error(schema, rows)
        best = schema.with_weights(self._best)
        before = mean_error(best, rows)
        if self.held_out <= before:
            self._best = schema.weights
            self._steps.optimiser.rate = min(self._config.rate, RECOVERY * self._steps.optimiser.rate)
        elif self.held_out > WORSE * before:
            self._go_back(best)
            self.held_out = before
            return best
        return schema

    def _go_back(self, schema: BodySchema) -> None:
        """Continue from the W of a schema, at half the learning rate."""
        self._steps.begin(schema, 0.5 * self._steps.optimiser.rate)
        self._steps.bias[:] = schema.bias
        self._unjudged = 0
        self.rolled_back += 1
