"""Record of a training."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class History:
    """Losses of every epoch [standard deviations squared], and facts about the training data.

    Attributes:
        train: Loss on the training data during each epoch.
        held_out: Loss on held-out data after each epoch.
        best: Held-out loss of the kept weights.
        best_epoch: Epoch whose weights were kept, counted from 0; -1 for those before the first epoch.
        skipped: Number of training samples that no mask fits or that have no measured output.
        rejected: Number of outliers: measured signals of single training samples that were rejected.
        dead: Elements (`signal.element`) that never varied in the training data or were never measured.
        notes: Remarks for the user, each one sentence that says what to do.
        resumed: Epoch at which an interrupted training was resumed; 0 if it was not interrupted.
    """

    train: tuple[float, ...]
    held_out: tuple[float, ...]
    best: float
    best_epoch: int
    skipped: int = 0
    rejected: int = 0
    dead: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    resumed: int = 0
