"""Online update (paper, II-F): p and W follow the body on a bounded window of samples, p faster than W.

The default has two time scales. p is recognised from every sample by extended Kalman filters
(`gemuco.adaption.recognise`); once it has settled, W takes small gradient steps under that p, mixed with training data
of the other conditions under their own p, and goes back when its error on held-out samples grows. The paper's three
methods are the other choices.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.recognise import RECOGNISERS, Prior, Recogniser
from gemuco.adaption.relearn import Relearner
from gemuco.adaption.seen import EXPLAINED, SeenErrors, excess
from gemuco.errors import SchemaError, check_kind
from gemuco.schema import BodySchema, check_schema

SPREAD = 0.1
"""A sample is new when an element moved this far since the last new one [standard deviations]. No steps are owed for
other samples: a robot at rest would otherwise pull W towards one posture."""
YOUNG = 1500
"""A window of fewer samples than this gets more steps for a new sample, in inverse proportion to its samples."""
ANOTHER = 0.3
"""The body has changed when p is this far from the p in use [standard deviations of the trained p]."""
NEWEST = 20
"""This is judged on at most this many of the newest samples."""
STEADY = 0.02
"""p is settled, by gradient, when a step moves it less than this [standard deviations of the trained p]."""


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """Result of one step.

    Attributes:
        steps: Number of gradient steps taken.
        loss: Mean squared error of the first batch before the step [standard deviations squared]; NaN if no gradient
            step was taken, infinite if a step led to an infinite number and was undone.
        window: Number of samples in the window.
        dropped: Number of dropped samples: the oldest, and those before a change of the body.
        bias: p now, shape (bias_size,).
        bias_std: Its standard deviation, shape (bias_size,); NaN by gradient.
        settled: Whether p is well known and explains what is seen: the errors are at most `EXPLAINED` times as large as
            learned. True if p is not updated. W is updated also under a p that does not explain all.
        changed: Whether this step recognised a change of the body.
        held_out: Mean squared error of held-out samples when last judged [standard deviations squared].
        rolled_back: Number of times W went back.
    """

    steps: int
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
        self._errors = SeenErrors(schema)
        self._unseen: np.ndarray | None = None
        self._newest: deque[np.ndarray] = deque(maxlen=NEWEST)
        self._excess = 1.0
        self._owed = 0.0
        self._last_new: np.ndarray | None = None
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
        self._errors.see(self.schema, x)
        self._newest.append(x)
        if self._unseen is not None:
            self._unseen = self._unseen & ~np.isfinite(x)
        if self._is_new(x):
            self._last_new = x
            self._owed = min(self._owed + self._steps_of_a_sample(), float(YOUNG * self.config.steps))
        return True

    def forget(self, count: int, schema: BodySchema) -> None:
        """Drop this number of the newest samples, in which a sensor lied, and go on from the schema before them."""
        self._relearner.window.forget_from(self._relearner.window.added - count)
        self._begin(schema)

    def _is_usable(self, x: np.ndarray) -> bool:
        whole = self.schema.layout.whole(np.isfinite(x))
        return any(m <= whole for m in self.schema.masks) and bool(np.isfinite(x[self.schema.out_index]).any())

    def _is_new(self, x: np.ndarray) -> bool:
        if self._last_new is None:
            return True
        distance = np.abs(x - self._last_new)
        return not np.isfinite(distance).any() or float(np.nanmax(distance)) >= SPREAD

    def _steps_of_a_sample(self) -> float:
        """Return the number of gradient steps for a new sample; 0 before the window has its minimum of samples."""
        count = len(self._relearner.window)
        if count < self.config.minimum:
            return 0.0
        return self.config.steps * min(max(1.0, YOUNG / count), float(self.config.repeats))

    @property
    def samples(self) -> np.ndarray:
        """Samples of the window [standard deviations], oldest first, shape (n, size)."""
        return self._relearner.window.rows()

    @property
    def owed(self) -> int:
        """Number of gradient steps still to be taken for the samples so far."""
        return round(self._owed)

    def step(self, most: int | None = None) -> UpdateResult:
        """Recognise p from the samples since the last step, then take gradient steps; `schema` is the result.

        Args:
            most: Maximum number of gradient steps; the others are taken at later calls. Without it all that are owed.
        """
        has_seen = bool(self._pending)
        has_changed = self._recognise()
        config, relearner = self.config, self._relearner
        moves_weights = config.what in ("weights", "both") or (config.what == "bias_then_weights" and self._is_settled)
        moves_bias = self._has_bias and self._recogniser is None
        loss, taken = float("nan"), 0
        count = self.owed if moves_weights else config.steps
        count = count if most is None else min(count, most)
        if count and len(relearner.window) >= config.minimum and (moves_weights or moves_bias):
            before, went_back = self.schema.bias, relearner.rolled_back
            schema, loss, taken = relearner.step(self.schema, count, moves_weights, moves_bias)
            self._owed = 0.0 if relearner.rolled_back > went_back else max(0.0, self._owed - taken)
            if moves_bias:
                self._is_settled = self._prior.between(before, schema.bias) < STEADY
            self.schema = schema
        if has_seen:
            if self._has_bias:
                self._excess = excess(self._first, self.schema, np.array(self._newest))
            self.schema = self._errors.renewed(self.schema, self._unseen, self._excess)
        return UpdateResult(
            steps=taken,
            loss=loss,
            window=len(relearner.window),
            dropped=relearner.window.dropped,
            bias=self.schema.bias,
            bias_std=self._bias_std,
            settled=self._is_settled and self._excess <= EXPLAINED,
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
            self.schema = self.schema.with_bias(recognition.bias, recognition.covariance)
        if has_changed:
            self._relearner.restart(self.schema)
            self._errors, self._owed = SeenErrors(self._first), 0.0
            self._unseen = ~np.isfinite(rows[-1])
            self._newest.clear()
            self._newest.extend(rows[-1:])
        return has_changed

    def rollback(self) -> BodySchema:
        """Go back to the first schema; the window is kept."""
        self._begin(self._first)
        return self.schema
