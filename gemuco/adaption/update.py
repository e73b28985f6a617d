"""Online update (paper, II-F): p and W follow the body, each at its own pace, on a bounded window of samples.

The default has two time scales. p is recognised from every sample by an extended Kalman filter
(`gemuco.adaption.recognise`); once it has settled W takes small gradient steps under that p, mixed with training data
of the other conditions under their own, and goes back when it predicts held-out samples worse than it did. The paper's
three ways are the other choices.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.recognise import RECOGNISERS, Prior, Recogniser
from gemuco.adaption.relearn import Relearner
from gemuco.errors import SchemaError, check_kind
from gemuco.schema import BodySchema, check_schema
from gemuco.signals import check_samples

FORGET = 0.01
"""Share by which each new sample moves the running estimate of the model's errors."""
ANOTHER = 0.3
"""The body is another one when p is this far from where it was [standard deviations of the trained p]."""
STEADY = 0.02
"""p found by gradient is settled when a step moves it less than this [standard deviations of the trained p]."""


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """What one step did.

    Attributes:
        loss: Mean squared error of the first batch before the step [standard deviations squared]; NaN if no gradient
            step was taken, infinite if it led out of the numbers and was undone.
        window: Samples in the window.
        dropped: Samples dropped so far: the oldest, and those of the body before it changed.
        bias: p now, shape (bias_size,).
        bias_std: Its standard deviation, shape (bias_size,); NaN by gradient.
        settled: Whether p is well known; always so when p is not updated.
        changed: Whether this step found that the body is another one since some samples.
        held_out: Mean squared error of held-out samples when last judged [standard deviations squared].
        rolled_back: How often W went back so far.
    """

    loss: float
    window: int
    dropped: int
    bias: np.ndarray
    bias_std: np.ndarray
    settled: bool
    changed: bool
    held_out: float
    rolled_back: int


class Updater:
    """Updates p and W while the body moves. One thread may use it; every schema it hands out is immutable.

    The errors of the schema it hands out are measured on each new sample before that sample is learned from, so the
    std of later estimates is honest about the body of today.

    Args:
        schema: Where to begin.
        config: What to update, and how.
        constraints: What is known of the body whatever its condition (origin, geometric model, ends of travel): signal
            -> arrays [its unit], shape (n, size), NaN where nothing is known. They count as samples of the window that
            never grow old.

    Raises:
        SchemaError: p shall be updated, but the schema has none.
        UnknownSignal: A constraint names a signal that is not in the layout.
        WrongSize: A constraint does not have its signal's size.
    """

    def __init__(
        self,
        schema: BodySchema,
        config: UpdateConfig | None = None,
        constraints: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        check_schema(schema)
        self.config = UpdateConfig() if config is None else config
        check_kind("The settings of an update", self.config, UpdateConfig, "an UpdateConfig")
        if not len(schema.bias) and self.config.what in ("bias", "both"):
            raise SchemaError(
                f"what '{self.config.what}' needs a parametric bias; this schema was trained without (bias_size 0)."
            )
        self._first = schema
        known = np.atleast_2d(schema.normalise(constraints)) if constraints else np.zeros((0, schema.layout.size))
        self._relearner = Relearner(schema, self.config, known.astype(np.float32))
        self._begin(schema)

    def _begin(self, schema: BodySchema) -> None:
        config = self.config
        self.schema = schema
        self._pending: list[np.ndarray] = []
        self._has_bias = len(schema.bias) > 0 and config.what != "weights"
        by_gradient = config.what == "both" or config.bias_method == "gradient"
        self._recogniser: Recogniser | None = None
        if self._has_bias and not by_gradient:
            self._recogniser = RECOGNISERS[config.bias_method](schema)
        self._prior = Prior.of(schema)
        self._since = self._relearner.window.added
        self._bias_std = np.full(len(schema.bias), np.nan)
        self._is_settled = not self._has_bias
        scale = schema.scaler.std[schema.out_index]
        self._errors = {
            m: (schema.errors[key] / scale) ** 2 for m in schema.masks if (key := ("mask", m)) in schema.errors
        }
        self._relearner.restart(schema)

    def add(self, values: Mapping[str, np.ndarray]) -> bool:
        """Put a sample into the window.

        Args:
            values: Signal -> measured array [its unit], shape (n,); NaN where nothing was measured.

        Returns:
            Whether it is of use: some mask must be whole, and something inferred must have been measured.

        Raises:
            UnknownSignal: A name is not in the layout.
            WrongSize: An array does not have its signal's size.
        """
        x = self.schema.normalise_one(values)
        if not self._is_usable(x):
            return False
        self._relearner.window.add(x)
        self._pending.append(x)
        self._measure(x)
        return True

    def _is_usable(self, x: np.ndarray) -> bool:
        whole = self.schema.layout.whole(np.isfinite(x))
        return any(m <= whole for m in self.schema.masks) and bool(np.isfinite(x[self.schema.out_index]).any())

    def _measure(self, x: np.ndarray) -> None:
        whole = self.schema.layout.whole(np.isfinite(x))
        data = x[self.schema.out_index]
        for m in self.schema.masks:
            if m <= whole:
                squared = (self.schema.infer(x, m) - data) ** 2
                known = self._errors.setdefault(m, squared)
                self._errors[m] = np.where(np.isfinite(squared), known + FORGET * (squared - known), known)

    def step(self) -> UpdateResult:
        """Recognise p from the samples since the last step, then take gradient steps; `schema` is the result."""
        has_changed = self._recognise()
        config, relearner = self.config, self._relearner
        moves_weights = config.what in ("weights", "both") or (config.what == "bias_then_weights" and self._is_settled)
        moves_bias = self._has_bias and self._recogniser is None
        loss = float("nan")
        if len(relearner.window) >= config.minimum and (moves_weights or moves_bias):
            before = self.schema.bias
            schema, loss = relearner.step(self.schema, moves_weights, moves_bias)
            if moves_bias:
                self._is_settled = self._prior.between(before, schema.bias) < STEADY
            scale = schema.scaler.std[schema.out_index]
            errors = dict(schema.errors) | {("mask", m): np.sqrt(e) * scale for m, e in self._errors.items()}
            self.schema = schema.with_weights(schema.weights, errors)
        return UpdateResult(
            loss=loss,
            window=len(relearner.window),
            dropped=relearner.window.dropped,
            bias=self.schema.bias,
            bias_std=self._bias_std,
            settled=self._is_settled,
            changed=has_changed,
            held_out=relearner.held_out,
            rolled_back=relearner.rolled_back,
        )

    def _recognise(self) -> bool:
        """Let every new sample move p; whether the body turned out to be another one."""
        rows, self._pending = self._pending, []
        if self._recogniser is None:
            return False
        has_changed = False
        window = self._relearner.window
        for index, row in enumerate(rows):
            found = self._recogniser.see(self.schema, row)
            since = window.added - len(rows) + index + 1 - found.since
            if since > self._since and self._prior.between(found.bias, self.schema.bias) > ANOTHER:
                window.forget_before(since)
                self._since, has_changed = since, True
            self._is_settled, self._bias_std = found.is_settled, np.sqrt(np.diag(found.covariance))
            self.schema = self.schema.with_bias(found.bias)
        if has_changed:
            self._relearner.restart(self.schema)
        return has_changed

    def rollback(self) -> BodySchema:
        """Back to the schema it began with; the window is kept."""
        self._begin(self._first)
        return self.schema


def adapt(
    schema: BodySchema, samples: Iterable[Mapping[str, np.ndarray]], config: UpdateConfig | None = None
) -> BodySchema:
    """Return the schema after the online update on samples, one step each; `Updater` takes them singly.

    Args:
        schema: Where to begin.
        samples: Signal -> value [its unit], shape (n,), oldest first.
        config: What to update, and how.
    """
    check_schema(schema)
    check_samples(samples)
    updater = Updater(schema, config)
    for values in samples:
        updater.add(values)
        updater.step()
    return updater.schema
