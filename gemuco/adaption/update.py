"""Online update (paper, II-F): p and W follow the body on a bounded window of samples, p faster than W.

The default has two time scales. p is recognised from every sample by extended Kalman filters
(`gemuco.adaption.recognise`); once it has settled, W takes small gradient steps under that p, mixed with training data
of the other conditions under their own p, and goes back when its error on held-out samples grows. The paper's three
methods are the other choices.
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
"""Each new sample moves the running mean of the model's errors by this share."""
ANOTHER = 0.3
"""The body has changed when p is this far from the p in use [standard deviations of the trained p]."""
STEADY = 0.02
"""p is settled, by gradient, when a step moves it less than this [standard deviations of the trained p]."""


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """Result of one step.

    Attributes:
        loss: Mean squared error of the first batch before the step [standard deviations squared]; NaN if no gradient
            step was taken, infinite if a step led to an infinite number and was undone.
        window: Number of samples in the window.
        dropped: Number of dropped samples: the oldest, and those before a change of the body.
        bias: p now, shape (bias_size,).
        bias_std: Its standard deviation, shape (bias_size,); NaN by gradient.
        settled: Whether p is well known; true if p is not updated.
        changed: Whether this step recognised a change of the body.
        held_out: Mean squared error of held-out samples when last judged [standard deviations squared].
        rolled_back: Number of times W went back.
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
    """Online update of p and W, for use by one thread; every resulting schema is immutable.

    The errors of the schema are measured on each new sample before that sample is learned from, so that the std of
    later estimates is that of the present body.

    Args:
        schema: The schema to begin with.
        config: Settings of the update.
        constraints: Known facts of the body in every condition (origin, geometric model, ends of travel): signal ->
            array [its unit], shape (n, size), NaN where not known. They count as samples of the window that never grow
            old.

    Raises:
        SchemaError: p is to be updated, but the schema has none.
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
            Whether the sample is of use: it must cover a mask and have a measured element of x_out.

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
        """Update p by every new sample; return whether the body has changed."""
        rows, self._pending = self._pending, []
        if self._recogniser is None:
            return False
        has_changed = False
        window = self._relearner.window
        for index, row in enumerate(rows):
            recognition = self._recogniser.see(self.schema, row)
            since = window.added - len(rows) + index + 1 - recognition.since
            if since > self._since and self._prior.between(recognition.bias, self.schema.bias) > ANOTHER:
                window.forget_before(since)
                self._since, has_changed = since, True
            self._is_settled = recognition.is_settled
            self._bias_std = np.sqrt(np.diag(recognition.covariance))
            self.schema = self.schema.with_bias(recognition.bias)
        if has_changed:
            self._relearner.restart(self.schema)
        return has_changed

    def rollback(self) -> BodySchema:
        """Go back to the first schema; the window is kept."""
        self._begin(self._first)
        return self.schema


def adapt(
    schema: BodySchema, samples: Iterable[Mapping[str, np.ndarray]], config: UpdateConfig | None = None
) -> BodySchema:
    """Return the schema after the online update on samples, one step each; `Updater` takes them singly.

    Args:
        schema: The schema to begin with.
        samples: Signal -> value [its unit], shape (n,), oldest first.
        config: Settings of the update.
    """
    check_schema(schema)
    check_samples(samples)
    updater = Updater(schema, config)
    for values in samples:
        updater.add(values)
        updater.step()
    return updater.schema
