"""Which masks have an error that is small enough, by one network that was trained under all of them.

Of many masks most are far from the threshold, and a few of the rows tell on which side (`Judge.race`).
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from gemuco.compiled.chain import pack
from gemuco.compiled.masks import Rows
from gemuco.compiled.race import KNOWN, Heats, Rule, Splits, race
from gemuco.errors import SchemaError
from gemuco.learning import cores, devices
from gemuco.structure.mask_errors import MaskErrors
from gemuco.structure.row_draw import RowDraw

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
TOLD = 30
"""An error is told by few rows where at least so many tell of every living element."""
TOGETHER = 32
"""So many masks are a core's next share: of too many at a time one core is left with the last."""


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


@dataclass(frozen=True, slots=True)
class Judged:
    """Masks and their errors.

    Attributes:
        masks: Truth values, shape (n, signals).
        L_m: Errors of the outputs under every mask, shape (n,).
        squared: Squared errors of every signal, shape (n, signals).
        is_rough: Which of them few rows told, shape (n,).
        total: Of these the sums of squared errors over the rows that they were measured on, shape (n, splits, size).
        done: And how many rows of each split these are, shape (n,).
    """

    masks: np.ndarray
    L_m: np.ndarray
    squared: np.ndarray
    is_rough: np.ndarray
    total: np.ndarray
    done: np.ndarray


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
        least = min(len(split.x) for split in self.errors)
        self._splits = self._lay_splits()
        self._heats = self._lay_heats([count for count in HEATS if 4 * count <= 3 * least])

    def is_judged(self, masks: np.ndarray) -> np.ndarray:
        """Whether a mask leaves any output to infer, shape (n,): the others are not judged (paper, II-E.3)."""
        return (self.outputs & ~masks).any(axis=1)

    def of(self, masks: np.ndarray) -> Judged:
        """Measure masks, shape (n, signals), on all rows."""
        squared = np.mean([split.of(masks) for split in self.errors], axis=0)
        L_m, is_rough = self._of_outputs(masks, squared), np.zeros(len(masks), bool)
        total, done = np.zeros((len(masks), len(self.errors), 0)), np.full(len(masks), -1)
        return Judged(masks, L_m, squared, is_rough, total, done)

    def race(self, masks: np.ndarray) -> Judged:
        """As `of`, but masks that are far from the threshold are measured on few rows.

        A race is over for what a heat on a few rows (`RowDraw`) puts surely on one side of the threshold; the others
        run the next heat, on more rows with those that they have, and at last on all.
        """
        # CUDA has measured them all before a race is over.
        if not len(self._heats.rows) or not len(masks) or devices.best() is not None:
            return self.of(masks)
        total = np.zeros((len(masks), len(self.errors), self.errors[0].x.shape[1]))
        squared, done = np.empty(masks.shape), np.zeros(len(masks), int)
        self._run(self._heats, masks, squared, total, done)
        whole = done < 0
        squared[whole] = self._of_sums(masks[whole], total[whole])
        return Judged(masks, self._of_outputs(masks, squared), squared, ~whole, total, done)

    def finish(self, judged: Judged, chosen: np.ndarray) -> None:
        """Measure those of some masks (indices) that few rows told on all rows; `judged` is changed."""
        chosen = chosen[judged.is_rough[chosen]]
        if not len(chosen):
            return
        masks, squared, total = judged.masks[chosen], judged.squared[chosen], judged.total[chosen]
        self._run(self._lay_heats([]), masks, squared, total, judged.done[chosen])
        judged.squared[chosen] = squared = self._of_sums(masks, total)
        judged.L_m[chosen], judged.is_rough[chosen] = self._of_outputs(masks, squared), False

    def _run(self, heats: Heats, masks: np.ndarray, *found: np.ndarray) -> None:
        """`race` on all cores; what is found goes to arrays with a line for each mask."""
        amounts = np.max([split.amounts for split in self.errors], axis=0)
        rule = Rule(self.outputs, self.thresholds.over == "masked", amounts, self._limit, SURE, BAD, TOLD)
        run, lines = partial(race, self._splits, heats, rule), (*self.errors[0].gates(masks), *found)
        parts = cores.parts(len(masks), TOGETHER)
        cores.run([partial(run, *(line[part] for line in lines)) for part in parts])

    def _of_sums(self, masks: np.ndarray, total: np.ndarray) -> np.ndarray:
        """Squared errors of every signal, shape (n, signals), from sums over all rows, shape (n, splits, size)."""
        return np.mean([split.of_sums(masks, total[:, index]) for index, split in enumerate(self.errors)], axis=0)

    def _lay_splits(self) -> Splits:
        """Networks and rows as a race takes them."""
        packed, given = [pack(split.chain) for split in self.errors], [split.given for split in self.errors]
        return Splits(
            np.stack([one.flat for one in packed]),
            packed[0].form,
            np.cumsum([0, *(len(split.x) for split in self.errors)]),
            Rows(*(np.concatenate(part) for part in zip(*given, strict=True))),
            np.stack([split.liveliness for split in self.errors]),
            np.repeat(np.arange(len(self.names)), self.errors[0].sizes),
        )

    def _lay_heats(self, rows: list[int]) -> Heats:
        """What the first so many rows of every split tell."""
        heats = [[draw.heat(count) for draw in self._draws] for count in rows]
        k = max((heat.known.shape[1] for line in heats for heat in line), default=0)
        tell = np.zeros((len(rows), len(self._draws), max(rows, default=0), KNOWN + 2 * k))
        for target, line in zip(tell, heats, strict=True):
            for columns, heat in zip(target, line, strict=True):
                columns[: len(heat), :KNOWN] = np.stack([heat.weights, heat.doubt, heat.hidden], axis=1)
                for begin, part in (KNOWN, heat.known), (KNOWN + k, heat.project):
                    columns[: len(heat), begin : begin + part.shape[1]] = part
        return Heats(np.array(rows, int), tell)

    def _of_outputs(self, masks: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """From squared errors of signals, shape (n, signals), those of the outputs as asked for, shape (n,)."""
        asked = np.broadcast_to(self.outputs, masks.shape)
        if self.thresholds.over == "masked":
            asked = asked & ~masks
        weights = (asked & np.isfinite(mean)) * np.max([split.amounts for split in self.errors], axis=0)
        total = weights.sum(axis=1)
        squared = (np.nan_to_num(mean) * weights).sum(axis=1) / np.where(total > 0.0, total, 1.0)
        return self._measured(np.where(total > 0.0, squared, np.nan))

    def _measured(self, squared: np.ndarray | float) -> np.ndarray:
        """Squared errors as asked for; infinite where nothing tells."""
        return np.where(np.isfinite(squared), squared if self.thresholds.measure == "mse" else np.sqrt(squared), np.inf)

    @property
    def _limit(self) -> float:
        """The threshold as a squared error."""
        into = self.thresholds.into
        return float(into if self.thresholds.measure == "mse" else into**2)
