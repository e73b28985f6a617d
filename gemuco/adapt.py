"""Online update (paper, II-F): W follows the body, by gradient steps on a bounded window of what it lived through."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gemuco.errors import SchemaError
from gemuco.kernels import pull_weights, trace
from gemuco.schema import BodySchema

OPTIMISERS = ("adam", "sgd")
FORGET = 0.01
"""Share by which each new sample moves the running estimate of the model's errors."""


@dataclass(frozen=True, slots=True)
class UpdateConfig:
    """How to update W.

    Attributes:
        window: Samples kept; the oldest are dropped.
        minimum: Samples needed before the first step.
        batch: Samples per gradient step, drawn from window and replay; each is used under every mask it allows.
        steps: Gradient steps per `Updater.step`.
        rate: Learning rate.
        optimiser: `adam` or `sgd` (with momentum 0.9).
        replay: As how many samples of the window the training data counts. A young window then cannot pull W far
            from what was known of postures it has not seen, and a full one outweighs what is known to be old.
        seed: For the draws.
    """

    window: int = 6000
    minimum: int = 50
    batch: int = 100
    steps: int = 3
    rate: float = 1e-3
    optimiser: str = "adam"
    replay: int = 300
    seed: int = 0

    def __post_init__(self) -> None:
        if self.optimiser not in OPTIMISERS:
            raise SchemaError(f"Optimiser '{self.optimiser}' is not known. Known optimisers: {', '.join(OPTIMISERS)}.")


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """What one step did.

    Attributes:
        loss: Mean squared error of the batch before the step [standard deviations squared]; NaN if too few samples,
            infinite if the step led out of the numbers and was not taken.
        window: Samples in the window.
        dropped: Oldest samples dropped so far.
    """

    loss: float
    window: int
    dropped: int


class Updater:
    """Learns W while the body moves. One thread may use it; every schema it hands out is immutable.

    The errors of the schema it hands out are measured on each new sample before that sample is learned from, so the
    std of later estimates is honest about the body of today.
    """

    def __init__(self, schema: BodySchema, config: UpdateConfig | None = None) -> None:
        self.config = config or UpdateConfig()
        self._first = schema
        self._rows = np.full((self.config.window, schema.layout.size), np.nan, np.float32)
        self._random = np.random.default_rng(self.config.seed)
        self._count = self._dropped = self._next = 0
        self._begin(schema)

    def _begin(self, schema: BodySchema) -> None:
        self.schema = schema
        self._arrays = [array.copy() for array in schema.weights.arrays()]
        self._slow = [np.zeros_like(array) for array in self._arrays]
        self._square = [np.zeros_like(array) for array in self._arrays]
        self._time = 0
        scale = schema.scaler.std[schema.out_index]
        self._errors = {
            m: (schema.errors[key] / scale) ** 2 for m in schema.masks if (key := ("mask", m)) in schema.errors
        }

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
        x = self.schema.normalise(values)
        if x.ndim != 1 or not self._usable(x):
            return False
        self._dropped += self._count == len(self._rows)
        self._count = min(self._count + 1, len(self._rows))
        self._rows[self._next] = x
        self._next = (self._next + 1) % len(self._rows)
        self._measure(x)
        return True

    def _usable(self, x: np.ndarray) -> bool:
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
        """A few gradient steps; `schema` is the result."""
        if self._count < self.config.minimum:
            return UpdateResult(float("nan"), self._count, self._dropped)
        losses: list[float] = []
        weights = self.schema.weights.replaced(self._arrays)
        for _ in range(self.config.steps):
            inputs, wanted = self._batch()
            values = trace(weights.whole, inputs)
            there = np.isfinite(wanted)
            difference = np.where(there, values[-1] - wanted, 0.0).astype(np.float32)
            count = max(1, int(there.sum()))
            losses.append(float(np.sum(difference**2)) / count)
            self._move(pull_weights(weights.whole, values, difference * np.float32(2.0 / count)))
        if not all(np.isfinite(array).all() for array in self._arrays):
            self._begin(self.schema)  # the step was too long: stay with the last W that is one
            return UpdateResult(float("inf"), self._count, self._dropped)
        scale = self.schema.scaler.std[self.schema.out_index]
        errors = dict(self.schema.errors) | {("mask", m): np.sqrt(e) * scale for m, e in self._errors.items()}
        self.schema = self.schema.with_weights(weights.replaced([a.copy() for a in self._arrays]), errors)
        return UpdateResult(losses[0], self._count, self._dropped)

    def _batch(self) -> tuple[np.ndarray, np.ndarray]:
        """Inputs (rows, inputs) and wanted x_out (rows, out_size): each drawn sample once per mask it allows."""
        config = self.config
        anchors = self.schema.anchors
        old = config.replay if len(anchors) else 0
        drawn = self._random.random(config.batch) * (self._count + old)
        lived = self._rows[drawn[drawn < self._count].astype(int)]
        replayed = anchors[self._random.integers(0, max(1, len(anchors)), config.batch - len(lived))]
        rows = np.concatenate([lived, replayed]) if len(replayed) else lived
        finite = np.isfinite(rows)
        inputs: list[np.ndarray] = []
        wanted: list[np.ndarray] = []
        for m in self.schema.masks:
            allowed = finite[:, self.schema.layout.indices(m)].all(axis=1)
            inputs.append(self.schema.network_input(rows[allowed], m))
            wanted.append(rows[allowed][:, self.schema.out_index])
        return np.concatenate(inputs), np.concatenate(wanted)

    def _move(self, gradients: list[np.ndarray]) -> None:
        """Adam, or gradient descent with momentum, in place on this updater's own copy of W."""
        rate = self.config.rate
        self._time += 1
        if self.config.optimiser == "sgd":
            for array, slow, gradient in zip(self._arrays, self._slow, gradients, strict=True):
                slow *= 0.9
                slow += gradient
                array -= rate * slow
            return
        gain = rate * np.sqrt(1.0 - 0.999**self._time) / (1.0 - 0.9**self._time)
        for array, slow, square, gradient in zip(self._arrays, self._slow, self._square, gradients, strict=True):
            slow += 0.1 * (gradient - slow)
            square += 0.001 * (gradient * gradient - square)
            array -= (gain * slow / (np.sqrt(square) + 1e-8)).astype(array.dtype)

    def rollback(self) -> BodySchema:
        """Back to the schema it began with; the window is kept."""
        self._begin(self._first)
        return self.schema
