"""Which masks have an error that is small enough, by one network that was trained under all of them.

Of many masks most are far from the threshold, and a few of the rows tell on which side (`Judge.race`).
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from gemuco import cores, devices
from gemuco.errors import SchemaError
from gemuco.mask_errors import MaskErrors

ROWS = 1000
"""Held-out rows that judge a mask, at most."""
HEATS = (64, 128, 256, 500)
"""Rows of a race before all of them."""
SURE = 4.0
"""A race is over for a mask whose error is so many standard errors from the threshold. Were squared errors normal, 1 of
12 000 masks that lie right at the threshold would be misjudged in a heat."""
ENOUGH = 256
"""From so many rows on a mask may count as surely below. Squared errors are skewed: a mean that is too large comes with
a large standard error, but where the bad rows are not among the few, both are too small."""
TOGETHER = 4_000_000
"""So many squared errors of single rows are held at a time by all cores, about."""


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
        self.errors = [split.thinned(ROWS).shuffled() for split in errors]
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
        mean = np.mean([split.of(masks) for split in self.errors], axis=0)
        return self._judged(masks, mean)[0], mean

    def race(self, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `of`, but masks that are far from the threshold are measured on few rows; and which these are, shape (n,).

        The rows are in a random order, so a heat on the first of them is not hurt by rows that follow one another being
        alike. For what is surely above the threshold the race is over, and from `ENOUGH` rows on for what is surely
        below; the others run the next heat, on more rows with those that they have, and at last on all.
        """
        least = min(len(split.x) for split in self.errors)
        # CUDA has measured them all before a race is over.
        heats = [rows for rows in HEATS if 2 * rows <= least] if devices.best() is None else []
        if not heats or not len(masks):
            return *self.of(masks), np.zeros(len(masks), bool)
        most = TOGETHER // (heats[-1] * sum(split.x.shape[1] for split in self.errors)) // cores.count()
        parts = cores.parts(len(masks), max(1, most))
        found = cores.run([partial(self._race, heats, masks[part]) for part in parts])
        mean, is_rough = (np.concatenate(column) for column in zip(*found, strict=True))
        return self._judged(masks, mean)[0], mean, is_rough

    def _race(self, heats: list[int], masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Squared errors of every signal under some masks, shape (n, signals), and which are rough, shape (n,)."""
        squared, is_rough = np.empty(masks.shape), np.ones(len(masks), bool)
        running = np.arange(len(masks))
        seen = [np.empty((len(masks), 0, split.x.shape[1]), np.float32) for split in self.errors]
        for rows in heats:
            seen = [
                np.concatenate([before, split.squares(masks[running], slice(before.shape[1], rows))], axis=1)
                for split, before in zip(self.errors, seen, strict=True)
            ]
            found, squared[running], spread = self._estimate(masks[running], seen)
            off = found - self._limit if rows < ENOUGH else np.abs(found - self._limit)
            goes_on = ~(off > SURE * spread)
            running, seen = running[goes_on], [before[goes_on] for before in seen]
        whole = [
            split.of_sums(masks[running], before.sum(axis=1, dtype=float) + split.sums(masks[running], heats[-1]))
            for split, before in zip(self.errors, seen, strict=True)
        ]
        squared[running], is_rough[running] = np.mean(whole, axis=0), False
        return squared, is_rough

    def _estimate(self, masks: np.ndarray, seen: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """From squares of the first rows of every split, (n, rows, size): the squared error of the outputs (n,), that
        of every signal (n, signals), and the standard error of the former (n,).
        """
        told = [split.of_squares(masks, squares) for split, squares in zip(self.errors, seen, strict=True)]
        mean = np.mean([errors for errors, _ in told], axis=0)
        _, found, weights = self._judged(masks, mean)
        variance = np.zeros(len(masks))
        for (_, factor), squares, split in zip(told, seen, self.errors, strict=True):
            rows, weight = squares.shape[1], np.repeat(weights, split.sizes, axis=1) * factor
            line = (squares @ weight[:, :, None].astype(np.float32))[:, :, 0]
            left = 1.0 - rows / len(split.x)  # rows are drawn from so many and no more
            variance += line.var(axis=1, ddof=1, dtype=float) / rows * left / len(self.errors) ** 2
        unclear = (self._asked(masks) & ~np.isfinite(mean)).any(axis=1)
        return found, mean, np.where(unclear, np.inf, np.sqrt(variance))

    def _asked(self, masks: np.ndarray) -> np.ndarray:
        """Which signals count in the error of a mask, shape (n, signals)."""
        judged = np.broadcast_to(self.outputs, masks.shape)
        return judged & ~masks if self.thresholds.over == "masked" else judged

    def _judged(self, masks: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """From errors of signals that of the outputs, as asked for and squared, (n,), and weights (n, signals)."""
        amounts = np.max([split.amounts for split in self.errors], axis=0)
        weights = (self._asked(masks) & np.isfinite(mean)) * amounts
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
