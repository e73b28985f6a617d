"""Comparison of the errors of masks with the thresholds of the structure determination."""

from dataclasses import dataclass

import numpy as np

from gemuco.errors import SchemaError
from gemuco.structure.mask_errors import MaskErrors

ROWS = 1000
"""A mask is measured on at most this many held-out rows of each split."""


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Largest errors of outputs and of feasible masks.

    Attributes:
        out: A signal with L_i below this is an output (the paper's C^out).
        into: A mask with L_m below this is feasible (the paper's C^in).
        measure: `mse` (mean squared error in standard deviations) or `rmse` (its root). The paper does not say which;
            its figures for the muscle-driven arm agree with `mse`.
        over: L_m is the mean over the `masked` outputs only, or over `all`. The paper's figures need `masked`: a
            network reproduces its inputs, and these would dilute the error of the inferred signals.
    """

    out: float = 0.15
    into: float = 0.15
    measure: str = "mse"
    over: str = "masked"

    def __post_init__(self) -> None:
        for name, value, known in (
            ("measure", self.measure, ("mse", "rmse")),
            ("over", self.over, ("masked", "all")),
        ):
            if value not in known:
                raise SchemaError(f"Structure {name} '{value}' is not known. Known: {', '.join(known)}.")
        for name, threshold in (("out", self.out), ("in", self.into)):
            if not 0.0 < threshold <= 1.0:
                raise SchemaError(
                    f"threshold_{name} is {threshold:g}; it must be above 0, and at most 1, the error of always "
                    "guessing the mean. The paper uses 0.15."
                )


class Judge:
    """Errors of masks compared with the thresholds.

    Args:
        names: The signals.
        errors: One per split of the data; errors are means over the splits.
        thresholds: Largest errors of outputs and of feasible masks.

    Attributes:
        L_i: Signal -> error when inferred from all others.
        outputs: Whether each signal can be inferred, truth values, shape (signals,).
        measured: Number of masks measured so far.
    """

    def __init__(self, names: tuple[str, ...], errors: tuple[MaskErrors, ...], thresholds: Thresholds) -> None:
        self.names, self.thresholds, self.measured = names, thresholds, 0
        self.errors = [split.thinned(ROWS) for split in errors]
        mean = self._measured(np.mean([split.from_others() for split in self.errors], axis=0))
        self.L_i = dict(zip(names, mean.tolist(), strict=True))
        self.outputs = np.array([self.L_i[name] < thresholds.out for name in names])

    def is_judged(self, masks: np.ndarray) -> np.ndarray:
        """Return whether each mask lacks an output, shape (n,); other masks are not judged (paper, II-E.3)."""
        return (self.outputs & ~masks).any(axis=1)

    def measure(self, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Measure masks, truth values, shape (n, signals), on all rows.

        Returns:
            L_m, the error of the outputs under every mask in the measure of the thresholds, shape (n,); and the squared
            error of every signal, shape (n, signals).
        """
        self.measured += len(masks)
        squared = np.mean([split.of(masks) for split in self.errors], axis=0)
        counted = np.broadcast_to(self.outputs, masks.shape)
        if self.thresholds.over == "masked":
            counted = counted & ~masks
        weights = (counted & np.isfinite(squared)) * np.max([split.amounts for split in self.errors], axis=0)
        total = weights.sum(axis=1)
        mean = (np.nan_to_num(squared) * weights).sum(axis=1) / np.where(total > 0.0, total, 1.0)
        return self._measured(np.where(total > 0.0, mean, np.nan)), squared

    def _measured(self, squared: np.ndarray) -> np.ndarray:
        """Return squared errors in the measure of the thresholds; infinite where there is no error."""
        is_plain = self.thresholds.measure == "mse"
        return np.where(np.isfinite(squared), squared if is_plain else np.sqrt(squared), np.inf)
