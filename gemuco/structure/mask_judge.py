"""Comparison of the errors of masks with the thresholds of the structure determination."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gemuco.errors import SchemaError
from gemuco.structure.inference import Split, infer_best, mean_of
from gemuco.structure.mask_errors import MaskErrors

ROWS = 1000
"""A mask is measured on at most this many held-out rows of each split."""
QUANTILES = (np.inf, 6.31, 2.92, 2.35, 2.13, 2.02, 1.94, 1.89, 1.86, 1.83)
"""Nine of ten means of n + 1 values are within this many standard errors of the truth (Student's t); 1.8 for more."""
HALF = 0.5
"""If no signal is below the threshold, those of which the others explain at least half, even if their standard error is
added, are used as poor outputs."""


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

    def share(self, error: float) -> float:
        """Return an error in the measure of the thresholds as a share of the standard deviation."""
        return float(np.sqrt(error)) if self.measure == "mse" else error


class Judge:
    """Errors of masks compared with the thresholds.

    Args:
        names: The signals.
        errors: One per split of the data; errors are means over the splits.
        thresholds: Largest errors of outputs and of feasible masks.

    Attributes:
        L_i: Signal -> error when inferred from its best mask.
        spread_i: Signal -> standard error of L_i over the splits; NaN with one split.
        best: Best mask of each signal, truth values, shape (signals, signals).
        rms_i: Signal -> root mean square of this error over the elements [unit].
        outputs: Whether each signal is an output, truth values, shape (signals,).
        poor: Whether each signal is an output although L_i is not below the threshold, shape (signals,).
        measured: Number of masks measured so far.
    """

    def __init__(self, names: tuple[str, ...], errors: Sequence[MaskErrors], thresholds: Thresholds) -> None:
        self.names, self.thresholds, self.measured = names, thresholds, 0
        self.splits: list[Split] = []
        if errors:
            self.add(*errors)

    @property
    def errors(self) -> list[MaskErrors]:
        """Network and held-out rows of every split."""
        return [split.errors for split in self.splits]

    def add(self, *errors: MaskErrors) -> None:
        """Add splits of the data and infer every signal anew."""
        self.splits += [Split(split.thinned(ROWS)) for split in errors]
        inference = infer_best(self.splits)
        L_i, spread = self._measured(mean_of(inference.shares)), self._spread(inference.shares)
        rms = np.sqrt(mean_of(inference.squares))
        self.best = inference.masks
        self.L_i, self.spread_i, self.rms_i = (
            dict(zip(self.names, values.tolist(), strict=True)) for values in (L_i, spread, rms)
        )
        self.outputs = L_i < self.thresholds.out
        self.poor = np.zeros(len(self.names), bool)
        if not self.outputs.any():
            squared = np.nan_to_num(mean_of(inference.shares), nan=np.inf)
            margin = np.nan_to_num(_standard_error(inference.shares))
            self.poor = (squared + margin < HALF) | (squared == squared.min())
            self.outputs = self.poor.copy()

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
        squared = mean_of([split.of(masks) for split in self.splits])
        return self._measured(self._over_outputs(masks, squared)), squared

    def spread(self, masks: np.ndarray) -> np.ndarray:
        """Return the standard error of L_m of measured masks over the splits, shape (n,); NaN with one split."""
        return self._spread([self._over_outputs(masks, split.of(masks)) for split in self.splits])

    def rms(self, masks: np.ndarray) -> np.ndarray:
        """Return the root mean square error of every signal under each mask [unit], shape (n, signals)."""
        return np.asarray(np.sqrt(mean_of([errors.in_units(masks) for errors in self.errors])))

    def is_open(self, values: np.ndarray, spreads: np.ndarray, threshold: float) -> np.ndarray:
        """Return whether the spread of each error leaves open on which side of its threshold it is, shape (n,)."""
        quantile = QUANTILES[len(self.splits) - 1] if len(self.splits) <= len(QUANTILES) else 1.8
        with np.errstate(invalid="ignore"):
            return np.isfinite(values) & ~(np.abs(values - threshold) > quantile * spreads)

    def _over_outputs(self, masks: np.ndarray, squared: np.ndarray) -> np.ndarray:
        """Return the mean of squared errors, shape (n, signals), over the outputs that count, shape (n,)."""
        counted = np.broadcast_to(self.outputs, masks.shape)
        if self.thresholds.over == "masked":
            counted = counted & ~masks
        weights = (counted & np.isfinite(squared)) * np.max([split.amounts for split in self.errors], axis=0)
        total = weights.sum(axis=1)
        mean = (np.nan_to_num(squared) * weights).sum(axis=1) / np.where(total > 0.0, total, 1.0)
        return np.where(total > 0.0, mean, np.nan)

    def _measured(self, squared: np.ndarray) -> np.ndarray:
        """Return squared errors in the measure of the thresholds; infinite where there is no error."""
        is_plain = self.thresholds.measure == "mse"
        return np.where(np.isfinite(squared), squared if is_plain else np.sqrt(squared), np.inf)

    def _spread(self, parts: np.ndarray | list[np.ndarray]) -> np.ndarray:
        """Return the standard error of the mean of squared errors by split, in the measure of the thresholds."""
        error = _standard_error(parts)
        return error if self.thresholds.measure == "mse" else error / np.maximum(2.0 * np.sqrt(mean_of(parts)), 1e-12)


def _standard_error(parts: np.ndarray | list[np.ndarray]) -> np.ndarray:
    """Return the standard error of the mean over the first axis; NaN with less than two values."""
    values = np.array(parts)
    known = np.isfinite(values)
    amounts, mean = known.sum(axis=0), mean_of(values)
    squares = (np.where(known, values - mean, 0.0) ** 2).sum(axis=0)
    return np.where(amounts > 1, np.sqrt(squares / np.maximum(amounts * (amounts - 1), 1)), np.nan)
