"""Structure determination (paper, II-E): which signals can be inferred, and from which masks.

With up to 10 signals all 2^n - 1 masks are measured. With more, the border between masks that are enough and masks that
are not is searched for (`mask_search`). A mask is feasible only if its own error was measured on all rows and is small
enough.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import compress
from pathlib import Path

import numpy as np

from gemuco.dataset import Data, as_dataset
from gemuco.errors import NotEnoughData, check_kind
from gemuco.learning.config import TrainConfig
from gemuco.learning.learner import Progress
from gemuco.learning.train import fit
from gemuco.masks import Mask, all_masks, bits, label
from gemuco.schema import BodySchema
from gemuco.signals import Layout
from gemuco.structure.mask_errors import LISTED, train_masks
from gemuco.structure.mask_judge import Judge, Thresholds
from gemuco.structure.mask_search import choose, find_border

__all__ = ["Judge", "Structure", "Thresholds", "determine", "learn", "search", "select"]

MOST_MASKS = 64
"""A schema has at most this many masks, because every mask costs time in training and in every estimate."""
BUDGET = 20_000
"""The search measures about this many masks at most."""
SHOWN = 40
"""The report's table has at most this many masks."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Result of structure determination.

    Attributes:
        layout: All signals.
        x_in: Inputs, the union of the masks.
        x_out: Outputs.
        masks: Feasible masks for the schema, the best first; at most `MOST_MASKS`.
        L_i: Signal -> error when inferred from all others; infinite if no held-out sample has it.
        L_m: Mask -> error of x_out, for every mask that was measured.
        thresholds: Largest errors of outputs and of feasible masks.
        is_whole: Whether every mask was measured, or the search ended because nothing was left to measure.
    """

    layout: Layout
    x_in: tuple[str, ...]
    x_out: tuple[str, ...]
    masks: tuple[Mask, ...]
    L_i: dict[str, float]
    L_m: dict[Mask, float]
    thresholds: Thresholds
    is_whole: bool = True

    @property
    def feasible(self) -> tuple[Mask, ...]:
        """Measured masks below the threshold, the best first."""
        return tuple(sorted((m for m in self.L_m if self.L_m[m] < self.thresholds.into), key=lambda m: self.L_m[m]))

    @property
    def listed(self) -> tuple[Mask, ...]:
        """The masks of the report: those of the smallest errors, at most `SHOWN`."""
        return tuple(sorted(self.L_m, key=lambda m: self.L_m[m])[:SHOWN])

    @property
    def remarks(self) -> tuple[str, ...]:
        """Facts that the tables do not show, one sentence each."""
        sentences: list[str] = []
        for name in self.x_out:
            if all(name in m for m in self.masks):
                sentences.append(
                    f"'{name}' is an output, but every feasible mask contains it (without it no mask is below "
                    "threshold_in): when it is missing it is estimated by descent on z."
                )
        for name in self.layout.names:
            if name not in self.x_in and name not in self.x_out:
                sentences.append(f"'{name}' is neither input nor output: the model does not use it.")
        if len(self.masks) < len(self.feasible):
            sentences.append(
                f"{len(self.feasible)} of {len(self.L_m)} measured masks are feasible; the {len(self.masks)} that "
                "serve random sets of available signals best are kept."
            )
        if not self.is_whole:
            sentences.append("The search stopped at its budget: there may be feasible masks that it did not measure.")
        return tuple(sentences)

    def report(self) -> str:
        """Return the errors and the result as tables of text."""
        shown = self.listed
        width = max([len(label(m, self.layout.names)) for m in shown] + [len(n) for n in self.L_i])
        unit = "mean squared error" if self.thresholds.measure == "mse" else "root mean square error"
        lines = [f"Errors on held-out data: {unit} in standard deviations.", ""]
        lines.append(f"{'inferred from all others':<{width}}  {'L_i':>7}  output if below {self.thresholds.out:g}")
        for name, value in self.L_i.items():
            lines.append(f"{name:<{width}}  {value:7.3f}  {'yes' if name in self.x_out else 'no'}")
        lines += ["", f"{'mask':<{width}}  {'L_m':>7}  feasible if below {self.thresholds.into:g}"]
        for m in shown:
            answer = "yes" if self.L_m[m] < self.thresholds.into else "no"
            lines.append(f"{label(m, self.layout.names):<{width}}  {self.L_m[m]:7.3f}  {answer}")
        if len(shown) < len(self.L_m):
            lines.append(f"and {len(self.L_m) - len(shown)} more")
        lines += ["", f"x_in  = {', '.join(self.x_in)}", f"x_out = {', '.join(self.x_out)}", *self.remarks]
        return "\n".join(lines)


def determine(
    data: Data,
    config: TrainConfig | None = None,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    splits: int = 1,
    drafts: Path | None = None,
    units: Mapping[str, str] | None = None,
) -> Structure:
    """Train once under all masks, measure masks on held-out episodes, and keep those that are feasible.

    Args:
        data: Episodes of one body, as a dataset or as plain arrays; see `as_dataset`.
        config: Settings of the training; the defaults if not given.
        thresholds: Largest errors of outputs and of feasible masks; those of the paper if not given.
        progress: Called with the finished share, 0 to 1, and a line of text.
        splits: Number of trainings, each with other episodes held out; errors are means over all. The paper uses one.
            Short recordings need more, because their errors depend strongly on the held-out part.
        drafts: A folder in which the trainings are saved, so that interrupted ones can be continued; see `fit`.
        units: Signal -> unit, of plain arrays.

    Raises:
        NotEnoughData: Too few samples or signals, a signal that never varies, or no signal or mask below its threshold.
    """
    dataset = as_dataset(data, units)
    config = TrainConfig() if config is None else config
    thresholds = Thresholds() if thresholds is None else thresholds
    check_kind("The settings of a training", config, TrainConfig, "a TrainConfig")
    check_kind("The thresholds", thresholds, Thresholds, "a Thresholds")
    names = dataset.layout.names
    if len(names) < 2:
        raise NotEnoughData(
            f"There is one signal, '{names[0]}', and nothing to infer it from; structure needs at least two."
            if names
            else "There is no signal; structure determination needs at least two."
        )
    judge = Judge(names, train_masks(dataset, config, splits, progress, drafts), thresholds)
    if not judge.outputs.any():
        least = min(judge.L_i, key=lambda name: judge.L_i[name])
        raise NotEnoughData(
            f"No signal can be inferred from the others (smallest L_i {judge.L_i[least]:.3f} of '{least}', "
            f"threshold_out {thresholds.out:g}); collect more data or raise the threshold."
        )
    if len(names) <= LISTED:
        masks, is_whole = np.array([bits(m, names) > 0 for m in all_masks(names)]), True
    else:
        masks, is_whole = search(judge, config.seed)
    return select(dataset.layout, judge, masks, is_whole, config.seed)


def learn(
    data: Data,
    config: TrainConfig | None = None,
    masks: Iterable[Iterable[str]] | None = None,
    x_out: Iterable[str] | None = None,
    units: Mapping[str, str] | None = None,
) -> BodySchema:
    """Learn a body from data (paper, II-D and II-E); `fit` also returns the record of the training.

    Args:
        data: Episodes of one body, as a dataset or as plain arrays; see `as_dataset`.
        config: Settings of the training; the defaults if not given.
        masks: The feasible masks; determined from the data if not given, and x_out with them.
        x_out: Signals to infer; every signal if masks are given and this is not.
        units: Signal -> unit, of plain arrays.
    """
    dataset = as_dataset(data, units)
    config = TrainConfig() if config is None else config
    if masks is None:
        structure = determine(dataset, config)
        masks, x_out = structure.masks, x_out or structure.x_out
    return fit(dataset, config, masks, x_out=x_out)[0]


def select(layout: Layout, judge: Judge, masks: np.ndarray, is_whole: bool, seed: int) -> Structure:
    """Measure masks, shape (n, signals), and keep at most `MOST_MASKS` of those that are feasible.

    Raises:
        NotEnoughData: No mask is feasible.
    """
    names, into = layout.names, judge.thresholds.into
    masks = masks[judge.is_judged(masks)]
    L_m, squared = judge.measure(masks)
    feasible = np.flatnonzero(L_m < into)
    if not len(feasible):
        raise NotEnoughData(
            f"No mask is enough to infer x_out ({', '.join(_named(names, judge.outputs))}): smallest L_m "
            f"{L_m.min():.3f}, threshold_in {into:g}; collect more data or raise the threshold."
        )
    kept = feasible[choose(masks[feasible], squared[feasible], judge.outputs, MOST_MASKS, seed)]
    kept = kept[np.argsort(L_m[kept], kind="stable")]
    sets = [frozenset(_named(names, line)) for line in masks]
    return Structure(
        layout=layout,
        x_in=_named(names, masks[kept].any(axis=0)),
        x_out=_named(names, judge.outputs),
        masks=tuple(sets[index] for index in kept),
        L_i=judge.L_i,
        L_m={m: float(value) for m, value in zip(sets, L_m, strict=True)},
        thresholds=judge.thresholds,
        is_whole=is_whole,
    )


def search(judge: Judge, seed: int) -> tuple[np.ndarray, bool]:
    """Search for masks that are enough.

    Returns:
        These and the largest that are not enough, shape (n, signals), and whether the search was completed.
    """
    enough: list[np.ndarray] = []

    def is_enough(masks: np.ndarray) -> np.ndarray:
        verdicts = ~judge.is_judged(masks)  # a mask that leaves nothing to infer is enough
        L_m, _ = judge.measure(masks[~verdicts])
        verdicts[~verdicts] = L_m < judge.thresholds.into
        enough.append(masks[verdicts])
        return verdicts

    border = find_border(is_enough, len(judge.names), BUDGET, seed)
    return np.concatenate([border.largest, *enough]), border.is_complete


def _named(names: tuple[str, ...], chosen: np.ndarray) -> tuple[str, ...]:
    return tuple(compress(names, chosen.tolist()))
