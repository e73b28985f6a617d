"""Which masks have an error that is small enough, by one network that was trained under all of them.

Of many masks most are far from the threshold, and a few of the rows tell on which side (`Judge.race`).
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from gemuco import cores, devices
from gemuco.compiled.masks import estimates
from gemuco.errors import SchemaError
from gemuco.mask_errors import MaskErrors
from gemuco.row_draw import Heat, RowDraw

ROWS = 1000
"""Held-out rows that judge a mask, at most."""
HEATS = (64, 96, 128, 192, 256, 384, 512, 700)
"""Rows of a race before all of them."""
SURE = 4.0
"""A race is over for a mask whose error is so many standard errors from the threshold. Were squared errors normal, 1 of
32 000 masks that lie right at the threshold would be put on the wrong side in a heat."""
BAD = 3
"""What is below must stay there were so many more rows as bad as the worst. Squared errors are skewed: a mean that is
too large comes with a large standard error, but where bad rows are not among the few, both are too small."""
TOGETHER = 8_000_000
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
        self.errors = [split.thinned(ROWS) for split in errors]
        self.tried = 0
        told = [split.from_others() for split in self.errors]
        mean = self._measured(np.mean([errors for errors, _ in told], axis=0))
        self.L_i = dict(zip(names, mean.tolist(), strict=True))
        self.outputs = np.array([self.L_i[name] < thresholds.out for name in self.names])
        self._others = [by_row for _, by_row in told]
        self._draws: list[RowDraw] = []
        self.draw(0)

    def draw(self, seed: int) -> None:
        """Put the rows in the order in which they race: by their errors under all signals but one.

        Args:
            seed: Of the draw.
        """
        self._draws = [RowDraw(others[:, :, self.outputs].sum(axis=2), seed) for others in self._others]
        self.errors = [split.rows(draw.order) for split, draw in zip(self.errors, self._draws, strict=True)]
        self._others = [others[:, draw.order] for others, draw in zip(self._others, self._draws, strict=True)]

    def is_judged(self, masks: np.ndarray) -> np.ndarray:
        """Whether a mask leaves any output to infer, shape (n,): the others are not judged (paper, II-E.3)."""
        return (self.outputs & ~masks).any(axis=1)

    def of(self, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the outputs, shape (n,), and squared errors of every signal, shape (n, signals)."""
        mean = np.mean([split.of(masks) for split in self.errors], axis=0)
        return self._judged(masks, mean)[0], mean

    def race(self, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `of`, but masks that are far from the threshold are measured on few rows; and which these are, shape (n,).

        A race is over for what a heat on a few rows (`RowDraw`) puts surely on one side of the threshold; the others
        run the next heat, on more rows with those that they have, and at last on all.
        """
        least = min(len(split.x) for split in self.errors)
        # CUDA has measured them all before a race is over.
        heats = [rows for rows in HEATS if 4 * rows <= 3 * least] if devices.best() is None else []
        if not heats or not len(masks):
            return *self.of(masks), np.zeros(len(masks), bool)
        most = TOGETHER // (heats[-1] * sum(split.x.shape[1] for split in self.errors)) // cores.count()
        parts = cores.parts(len(masks), max(1, most))
        steps = [[draw.heat(rows) for draw in self._draws] for rows in heats]
        found = cores.run([partial(self._race, steps, masks[part]) for part in parts])
        mean, is_rough = (np.concatenate(column) for column in zip(*found, strict=True))
        return self._judged(masks, mean)[0], mean, is_rough

    def _race(self, heats: list[list[Heat]], masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Squared errors of every signal under some masks, shape (n, signals), and which are rough, shape (n,).

        Args:
            heats: Of every split in every heat.
            masks: Shape (n, signals), truth values.
        """
        squared, is_rough = np.empty(masks.shape), np.ones(len(masks), bool)
        running, done = np.arange(len(masks)), 0
        most = len(heats[-1][0])
        seen = [np.empty((len(masks), most, split.x.shape[1]), np.float32) for split in self.errors]
        for heat in heats:
            for split, kept in zip(self.errors, seen, strict=True):
                split.squares(masks[running], slice(done, len(heat[0])), kept, running)
            done = len(heat[0])
            found, squared[running], spread, hidden = self._estimate(masks[running], running, seen, heat)
            over = found - self._limit
            running = running[~((over > SURE * spread) | (over + BAD * hidden < -SURE * spread))]
        whole = [
            split.of_sums(masks[running], kept[running].sum(axis=1, dtype=float) + split.sums(masks[running], done))
            for split, kept in zip(self.errors, seen, strict=True)
        ]
        squared[running], is_rough[running] = np.mean(whole, axis=0), False
        return squared, is_rough

    def _estimate(
        self, masks: np.ndarray, lines: np.ndarray, seen: list[np.ndarray], heat: list[Heat]
    ) -> tuple[np.ndarray, ...]:
        """From squares of the first rows of every split, (lines, rows, size), of masks (n, signals) in these lines.

        Returns:
            The squared error of the outputs, shape (n,), that of every signal, shape (n, signals), and of the former
            the standard error and how much one bad row may hide, shapes (n,).
        """
        share = 1.0 / len(self.errors)
        factors = [split.factors(masks, one.weights) for split, one in zip(self.errors, heat, strict=True)]
        tells = np.isfinite(sum(split.by_signal(one) for split, one in zip(self.errors, factors, strict=True)))
        weights = self._weights(masks, tells)
        mean, variance, hidden = np.zeros(masks.shape), np.zeros(len(masks)), np.zeros(len(masks))
        for split, kept, factor, one in zip(self.errors, seen, factors, heat, strict=True):
            judged = np.nan_to_num(np.repeat(weights, split.sizes, axis=1) * factor)
            told, doubt, worst = estimates(
                kept, lines, judged, one.weights, one.known, one.project, one.doubt, one.hidden
            )
            mean += share * split.by_signal(told * factor)
            variance += share**2 * doubt
            hidden += share * worst
        unclear = (self._asked(masks) & ~tells).any(axis=1)
        mean = np.maximum(mean, 0.0)  # few rows may tell less than nothing
        return self._judged(masks, mean)[1], mean, np.where(unclear, np.inf, np.sqrt(variance)), hidden

    def _asked(self, masks: np.ndarray) -> np.ndarray:
        """Which signals count in the error of a mask, shape (n, signals)."""
        judged = np.broadcast_to(self.outputs, masks.shape)
        return judged & ~masks if self.thresholds.over == "masked" else judged

    def _weights(self, masks: np.ndarray, tells: np.ndarray) -> np.ndarray:
        """How much the error of a signal adds to that of a mask, shape (n, signals).

        Args:
            masks: Truth values, shape (n, signals).
            tells: Whether the error of the signal under the mask is known, shape (n, signals).
        """
        weights = (self._asked(masks) & tells) * np.max([split.amounts for split in self.errors], axis=0)
        total = weights.sum(axis=1, keepdims=True)
        return np.asarray(weights / np.where(total > 0.0, total, 1.0))

    def _judged(self, masks: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From errors of signals that of the outputs, as asked for and squared, shapes (n,)."""
        weights = self._weights(masks, np.isfinite(mean))
        squared = np.where(weights.any(axis=1), (np.nan_to_num(mean) * weights).sum(axis=1), np.nan)
        return self._measured(squared), squared

    def _measured(self, squared: np.ndarray | float) -> np.ndarray:
        """Squared errors as asked for; infinite where nothing tells."""
        return np.where(np.isfinite(squared), squared if self.thresholds.measure == "mse" else np.sqrt(squared), np.inf)

    @property
    def _limit(self) -> float:
        """The threshold as a squared error."""
        into = self.thresholds.into
        return into if self.thresholds.measure == "mse" else into**2
