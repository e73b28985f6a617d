"""How a training went, for a plot and in sentences."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class History:
    """How training went: losses [standard deviations squared] after every epoch, and what the data were like.

    Attributes:
        train: Loss on the training data while it was learned, one per epoch.
        held_out: Loss on held-out data, one per epoch.
        best_epoch: Whose weights were kept, counted from 0.
        skipped: Training samples that no mask fits, or with nothing measured to learn from.
        rejected: Measured signals of single training samples that were taken for outliers.
        dead: Elements (`signal.element`) that never varied in the training data or were never measured.
        notes: What else a person should know, each a sentence that says what to do.
        resumed: At which epoch an interrupted training went on; 0 if it ran in one piece.
    """

    train: tuple[float, ...]
    held_out: tuple[float, ...]
    best_epoch: int
    skipped: int = 0
    rejected: int = 0
    dead: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    resumed: int = 0

    @property
    def best(self) -> float:
        """Held-out loss of the weights that were kept."""
        return self.held_out[self.best_epoch]
