"""Which masks have an error that is small enough, by one network that was trained under all of them.

Of many masks most can be told to be hopeless from a few of the rows (`Judge.race`); feasible ones get all rows.
"""

from dataclasses import dataclass

import numpy as np

from gemuco import devices
from gemuco.errors import SchemaError
from gemuco.mask_errors import MaskErrors

ROWS = 1000
"""Held-out rows that judge a mask, at most."""
HEATS = (64, 256)
"""Rows of a race before all of them."""
SURE = 4.0
"""A mask is out of the race when its error is so many standard errors above the threshold. Were squared errors normal,
1 of 12 000 masks that lie right at the threshold would be lost in a heat; they are skewed, and that errs the other way:
where a sample makes a mask look too bad, a few rows do, and the standard error is large too."""


@dataclass(frozen=True, slots=True)
class Thresholds:
    """When something counts as inferable.

    Attributes:
        out: A signal whose L_i is below is an output (the paper's C^out).
        into: A mask whose L_m is below is feasible (the paper's C^in).
        measure: `mse` (mean squared error in standard deviations) or `rmse` (its root). The paper leaves it open; its
            figures for the muscle-driven arm fit `mse`.
        over: L_m over the `masked` outputs only, or over `all`. The paper's own figures need `masked`: what a network
            is given it also gives back, and that would dilute the error of what it must infer.
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
        names: Of the signals.
        errors: One per split of the data.
        thresholds: What is small enough.

    Attributes:
        L_i: Signal -> error when inferred from all others.
        outputs: Which signals can be inferred, truth values, shape (signals,).
        tried: How many masks the search has asked for.
    """

    def __init__(self, names: tuple[str, ...], errors: tuple[MaskErrors, ...], thresholds: Thresholds) -> None:
        self.names, self.thresholds = names, thresholds
        self.errors = [split.thinned(ROWS) for split in errors]
        self.tried = 0
        self.L_i = {
            name: float(self._measured(float(np.mean([split.from_others(i) for split in self.errors]))))
            for i, name in enumerate(names)
        }
        self.outputs = np.array([self.L_i[name] < thresholds.out for name in self.names])

    def is_judged(self, masks: np.ndarray) -> np.ndarray:
        """Whether a mask leaves any output to infer, shape (n,): the others are not judged (paper, II-E.3)."""
        return (self.outputs & ~masks).any(axis=1)

    def of(self, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the outputs, shape (n,), and squared errors of every signal, shape (n, signals)."""
        found, sizes = zip(*(errors.of(masks) for errors in self.errors), strict=True)
        mean = np.mean(found, axis=0)
        return self._judged(masks, mean, np.max(sizes, axis=0))[0], mean

    def race(self, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `of`, but masks that are hopeless are measured on few rows; and which these are, shape (n,).

        A heat is run on some of the rows that judge, drawn at random, so that it does not matter how rows that follow
        one another are alike. What is surely above the threshold is out; what looks feasible gets all rows, and with
        them the errors that `of` gives; what may be either runs the next heat, and then gets all rows too.
        """
        errors, squared = np.empty(len(masks)), np.empty(masks.shape)
        is_out, running = np.zeros(len(masks), bool), np.arange(len(masks))
        for rows in HEATS if devices.best() is None else ():  # CUDA has measured them all before a race is over
            if min(len(split.x) for split in self.errors) < 2 * rows or not len(running):
                break
            found, mean, spread = self._heat(masks[running], rows)
            lost = found - SURE * spread > self._limit
            out = running[lost]
            is_out[out], errors[out], squared[out] = True, self._measured(found[lost]), mean[lost]
            running = running[~lost & ~(found < self._limit)]
        if not is_out.all():
            errors[~is_out], squared[~is_out] = self.of(masks[~is_out])
        return errors, squared, is_out

    def _heat(self, masks: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Squared error of the outputs (n,), of every signal (n, signals), and standard error of the former (n,)."""
        parts = [split.drawn(rows).by_row(masks) for split in self.errors]  # (n, rows, signals)
        sizes = np.max([split.amounts for split in self.errors], axis=0)
        mean = np.mean([part.mean(axis=1, dtype=float) for part in parts], axis=0)
        _, found, weights = self._judged(masks, mean, sizes)
        variance = np.zeros(len(masks))
        for part, split in zip(parts, self.errors, strict=True):
            line = np.einsum("nrs,ns->nr", np.nan_to_num(part), weights, dtype=float)
            left = 1.0 - rows / len(split.x)  # rows are drawn from so many and no more
            variance += line.var(axis=1, ddof=1) / rows * left / len(parts) ** 2
        unclear = (self._asked(masks) & ~np.isfinite(mean)).any(axis=1)
        return found, mean, np.where(unclear, np.inf, np.sqrt(variance))

    def _asked(self, masks: np.ndarray) -> np.ndarray:
        """Which signals count in the error of a mask, shape (n, signals)."""
        judged = np.broadcast_to(self.outputs, masks.shape)
        return judged & ~masks if self.thresholds.over == "masked" else judged

    def _judged(
        self, masks: np.ndarray, mean: np.ndarray, sizes: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """From errors of signals that of the outputs, as asked for and squared, (n,), and weights (n, signals)."""
        weights = (self._asked(masks) & np.isfinite(mean)) * sizes
        total = weights.sum(axis=1)
        weights = weights / np.where(total > 0.0, total, 1.0)[:, None]
        squared = np.where(total > 0.0, (np.nan_to_num(mean) * weights).sum(axis=1), np.nan)
        return self._measured(squared), squared, weights

    def _measured(self, squared: np.ndarray | float) -> np.ndarray:
        """Squared errors as asked for; infinite where nothing tells."""
        return np.where(np.isfinite(squared), squared if self.thresholds.measure == "mse" else np.sqrt(squared), np.inf)

    @property
    def _limit(self) -> float:
        """The threshold as a squared error."""
        into = self.thresholds.into
        return into if self.thresholds.measure == "mse" else into**2
