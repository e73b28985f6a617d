"""Settings of a training."""

import math
from dataclasses import dataclass

from gemuco.errors import SchemaError, check_kind, whole_number
from gemuco.layers import check_activation

MOST_BIAS = 3
"""A length of p that follows the data is at most this."""
LATENT = 15, 40
"""A z that follows the data has one element per output, but not less and not more elements than these."""
BATCH = 50, 500
"""A batch that follows the data is a tenth of the samples, but not smaller and not larger than these."""
STEPS = 4000
"""A number of epochs that follows the data is this many steps."""
PATIENCE = 0.4
"""A patience that follows the data is this share of the epochs."""


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """Settings of a training.

    Attributes:
        hidden: Widths of the encoder's layers; the decoder mirrors them.
        latent: Length of z; None if it follows the number of outputs.
        activation: Activation of the hidden layers: tanh, relu, sigmoid, elu or softplus.
        bias_size: Length of p, one p per condition; 0 without parametric bias, None if it follows the data.
        epochs: Largest number of passes over the data; None if it follows the number of samples.
        batch: Samples per step; None if it follows the number of samples.
        rate: Peak of the one-cycle learning rate of W (SOAP).
        bias_rate: Peak of the one-cycle learning rate of p.
        held_out: Share of every condition's episodes (or time blocks) that is held out of the training to measure it.
        patience: The training stops after this many epochs without a better held-out loss, once the loss on the
            training data is lower; None if it follows the number of epochs.
        outliers: A measured signal is rejected while the model, which does not see it, misses it by more than this
            many robust standard deviations of its misses. Infinite: nothing is rejected, and the loss is the square.
        replay: Fine-tuning only: number of old training samples per new sample.
        seed: Seed of the split, the initial weights, the masks and the order of samples.
    """

    hidden: tuple[int, ...] = (200, 30)
    latent: int | None = None
    activation: str = "tanh"
    bias_size: int | None = None
    epochs: int | None = None
    batch: int | None = None
    rate: float = 1e-2
    bias_rate: float = 1e-2
    held_out: float = 0.2
    patience: int | None = None
    outliers: float = 6.0
    replay: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        check_activation(self.activation)
        check_kind("Training: hidden", self.hidden, (tuple, list), "a tuple of widths, such as (200, 30)")
        object.__setattr__(self, "hidden", tuple(self.hidden))
        whole_number("Training: seed", self.seed, 0)
        for name, least in (("latent", 1), ("epochs", 1), ("batch", 1), ("patience", 1), ("bias_size", 0)):
            if getattr(self, name) is not None:
                whole_number(f"Training: {name}", getattr(self, name), least)
        for width in self.hidden:
            if width < 1:
                raise SchemaError(f"Training: a hidden layer of {width} is impossible; leave it out or make it wider.")
            whole_number("Training: the width of a hidden layer", width, 1)
        for name in ("rate", "bias_rate", "replay"):
            if not 0.0 <= getattr(self, name) < float("inf"):
                raise SchemaError(f"Training: {name} is {getattr(self, name)}; it must be 0 or a positive number.")
        if not 0.0 < self.held_out < 1.0:
            raise SchemaError(f"Training: held_out is {self.held_out}; it is a share between 0 and 1.")
        if not self.outliers > 0.0:
            raise SchemaError(f"Training: outliers is {self.outliers}; use infinity to reject nothing.")

    def latent_for(self, outputs: int) -> int:
        """Return the length of z for a number of x_out elements."""
        return min(max(outputs, LATENT[0]), LATENT[1]) if self.latent is None else self.latent

    def batch_for(self, samples: int) -> int:
        """Return the samples per step for a number of training samples."""
        return min(max(samples // 10, BATCH[0]), BATCH[1]) if self.batch is None else self.batch

    def epochs_for(self, samples: int) -> int:
        """Return the largest number of epochs for a number of training samples."""
        if self.epochs is not None:
            return self.epochs
        return max(1, round(STEPS / max(1, math.ceil(samples / self.batch_for(samples)))))

    def patience_for(self, epochs: int) -> int:
        """Return the patience for a largest number of epochs."""
        return max(20, round(PATIENCE * epochs)) if self.patience is None else self.patience

    def bias_for(self, conditions: int) -> int:
        """Return the length of p for a number of conditions.

        Without a `bias_size` p spans the conditions, one dimension less than there are, up to `MOST_BIAS`.
        """
        return min(conditions - 1, MOST_BIAS) if self.bias_size is None else self.bias_size
