"""Structure determination (paper, II-E): which signals can be inferred, and from which masks.

With up to 10 signals all 2^n - 1 masks are measured. With more, the border between masks that are enough and masks that
are not is searched for (`mask_search`). A mask is feasible only if its own error was measured on all rows and is small
enough. Other data are held out again and again until the errors are on one side of their thresholds.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import compress
from pathlib import Path

import numpy as np

from gemuco.compiled.blas import cores
from gemuco.dataset import Data, Dataset, as_dataset
from gemuco.errors import NotEnoughData, check_kind
from gemuco.learning.config import TrainConfig
from gemuco.learning.learner import Progress
from gemuco.learning.train import fit
from gemuco.masks import Mask, all_masks, bits
from gemuco.scaler import Scaler
from gemuco.schema import BodySchema
from gemuco.signals import Layout
from gemuco.structure.mask_errors import LISTED
from gemuco.structure.mask_judge import Judge, Thresholds
from gemuco.structure.mask_search import choose, find_border
from gemuco.structure.mask_training import train_masks
from gemuco.structure.result import Structure

__all__ = ["Judge", "Structure", "Thresholds", "determine", "learn", "search", "select"]

MOST_MASKS = 64
"""A schema has at most this many masks, because every mask costs time in training and in every estimate."""
BUDGET = 20_000
"""The search measures about this many masks at most."""
FIRST_SPLITS, MOST_SPLITS = 2, 10
"""If it is not given, the number of splits is between these."""
BORDER = 0.2
"""A mask whose error is known to this share of its threshold needs no further split."""
POOR = 1.2
"""If no mask is feasible, those with errors up to this multiple of the smallest are kept."""


def determine(
    data: Data,
    config: TrainConfig | None = None,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    splits: int | None = None,
    drafts: Path | None = None,
    units: Mapping[str, str] | None = None,
) -> Structure:
    """Train under all masks, measure masks on held-out data, and keep those that are feasible.

    If no signal or no mask is below its threshold, the best are kept and marked as poor (`Structure.poor`).

    Args:
        data: Episodes of one body, as a dataset or as plain arrays; see `as_dataset`.
        config: Settings of the training; the defaults if not given.
        thresholds: Largest errors of outputs and of feasible masks; those of the paper if not given.
        progress: Called with the finished share, 0 to 1, and a line of text.
        splits: Number of trainings, each with other motions held out; errors are means over all. The paper uses one. If
            not given, there are at least two, and more (at most ten) until every error is on one side of its threshold.
        drafts: A folder in which the trainings are saved, so that interrupted ones can be continued; see `fit`.
        units: Signal -> unit, of plain arrays.

    Raises:
        NotEnoughData: Too few samples, or fewer than two signals that vary.
    """
    dataset = as_dataset(data, units)
    config = TrainConfig() if config is None else config
    thresholds = Thresholds() if thresholds is None else thresholds
    check_kind("The settings of a training", config, TrainConfig, "a TrainConfig")
    check_kind("The thresholds", thresholds, Thresholds, "a Thresholds")
    if config.epochs is None:  # enough to rank masks
        config = replace(config, epochs=max(1, config.epochs_for(len(dataset)) // 4))
    alive, notes = _alive(dataset)
    judge = Judge(alive.layout.names, (), thresholds)
    first, most = (FIRST_SPLITS, MOST_SPLITS) if splits is None else (splits, splits)
    judge.add(*train_masks(alive, config, first, _share(progress, 0, first), drafts))
    done = first
    while done < most and not _is_decided(judge):
        beside = min(cores(), most - done)
        for errors in train_masks(alive, config, beside, _share(progress, done, beside), drafts, done):
            if not _is_decided(judge):  # so that the result does not depend on the number of cores
                judge.add(errors)
        done += beside
    if progress is not None:
        progress(1.0, "structure")
    if len(alive.layout.names) <= LISTED:
        masks, is_whole = _every(judge.names), True
    else:
        masks, is_whole = search(judge, config.seed)
    return select(dataset.layout, judge, masks, is_whole, config.seed, (*notes, *alive.repetitions()))


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
    if masks is not None:
        return fit(dataset, config, masks, x_out=x_out)[0]
    structure = determine(dataset, config)
    return fit(dataset, config, structure.masks, x_out=x_out or structure.x_out)[0].with_manifest(**structure.facts)


def select(
    layout: Layout, judge: Judge, masks: np.ndarray, is_whole: bool, seed: int, notes: tuple[str, ...] = ()
) -> Structure:
    """Measure masks, shape (n, signals), and keep at most `MOST_MASKS` of those that are feasible, or of the best.

    Raises:
        NotEnoughData: No held-out sample has the signals of any mask.
    """
    names, into = judge.names, judge.thresholds.into
    masks = masks[judge.is_judged(masks)]
    L_m, squared = judge.measure(masks)
    if not np.isfinite(L_m).any():
        raise NotEnoughData(
            f"No held-out sample has two of the signals {', '.join(names)} at once; record them together."
        )
    spread = judge.spread(masks)
    feasible = np.flatnonzero(L_m < into if (L_m < into).any() else POOR * L_m.min() >= L_m)
    kept = feasible[choose(masks[feasible], squared[feasible], judge.outputs, MOST_MASKS, seed)]
    kept = kept[np.argsort(L_m[kept], kind="stable")]
    sets = [frozenset(_named(names, line)) for line in masks]
    structure = Structure(
        layout=layout,
        x_in=_named(names, masks[kept].any(axis=0)),
        x_out=_named(names, judge.outputs),
        masks=tuple(sets[index] for index in kept),
        L_i=judge.L_i,
        L_m={m: float(value) for m, value in zip(sets, L_m, strict=True)},
        thresholds=judge.thresholds,
        is_whole=is_whole,
        spread_i=judge.spread_i,
        spread_m={m: float(value) for m, value in zip(sets, spread, strict=True)},
        rms_i=judge.rms_i,
        best={name: frozenset(_named(names, line)) for name, line in zip(names, judge.best, strict=True)},
        splits=len(judge.splits),
        open=tuple(_open(judge, sets, L_m, spread)),
        poor=_named(names, judge.poor),
        notes=notes,
    )
    return _with_units(structure, judge)


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


def _alive(dataset: Dataset) -> tuple[Dataset, list[str]]:
    """Return the dataset without signals that never vary or were never measured, and a sentence on each of these."""
    layout, rows = dataset.layout, dataset.rows()
    if not len(rows):
        raise NotEnoughData("There are no samples to train from; record some with `gemuco collect`.")
    measured = np.isfinite(rows).any(axis=0)
    dead = np.isin(np.arange(layout.size), Scaler.fit(layout, rows).dead) if measured.any() else ~measured
    notes, alive = [], []
    for name in layout.names:
        span = layout.slice(name)
        if dead[span].all():
            fact = "never varies" if measured[span].any() else "was never measured"
            notes.append(f"Signal '{name}' {fact}, so nothing can be learned of it; check its sensor, or move it.")
        else:
            alive.append(name)
    if len(alive) < 2:
        what = f"There is one signal, '{alive[0]}', and nothing to infer it from" if alive else "There is no signal"
        raise NotEnoughData(" ".join([f"{what}; structure needs at least two that vary.", *notes]))
    return dataset if len(alive) == len(layout.names) else dataset.with_layout(layout.subset(alive)), notes


def _share(progress: Progress | None, split: int, count: int) -> Progress | None:
    """Return the progress of `count` splits from `split`, as a share of all if one more split may follow."""
    if progress is None:
        return None
    begin, end = (done / (done + 1.0) for done in (split, split + count))
    return lambda done, text: progress(begin + (end - begin) * done, text)


def _is_decided(judge: Judge) -> bool:
    """Whether all errors are on one side of their thresholds, or known well enough to say that they are near it.

    With many signals only L_i is considered, because the search for masks is long.
    """
    L_i, spread_i = (np.array([part[name] for name in judge.names]) for part in (judge.L_i, judge.spread_i))
    if judge.is_open(L_i, spread_i, judge.thresholds.out).any():
        return False
    if len(judge.names) > LISTED:
        return True
    masks = _every(judge.names)
    masks = masks[judge.is_judged(masks)]
    spread, into = judge.spread(masks), judge.thresholds.into
    return not (judge.is_open(judge.measure(masks)[0], spread, into) & ~(spread < BORDER * into)).any()


def _open(judge: Judge, sets: list[Mask], L_m: np.ndarray, spread: np.ndarray) -> list[str | Mask]:
    """Return the signals and masks whose errors may be on either side of the threshold."""
    if len(judge.splits) < 2:
        return []
    L_i, spread_i = (np.array([part[name] for name in judge.names]) for part in (judge.L_i, judge.spread_i))
    signals = compress(judge.names, judge.is_open(L_i, spread_i, judge.thresholds.out).tolist())
    return [*signals, *compress(sets, judge.is_open(L_m, spread, judge.thresholds.into).tolist())]


def _with_units(structure: Structure, judge: Judge) -> Structure:
    """Return the structure with the errors of the listed masks in the units of the outputs."""
    listed = structure.listed
    rms = judge.rms(np.array([bits(m, judge.names) > 0 for m in listed]))
    table = {
        m: {name: float(value) for name, value in zip(judge.names, line, strict=True) if name in structure.x_out}
        for m, line in zip(listed, rms, strict=True)
    }
    lacking = {m: {name: value for name, value in row.items() if name not in m} for m, row in table.items()}
    return replace(structure, rms_m=lacking)


def _every(names: tuple[str, ...]) -> np.ndarray:
    """Return every mask, truth values, shape (masks, signals)."""
    return np.array([bits(m, names) > 0 for m in all_masks(names)])


def _named(names: tuple[str, ...], chosen: np.ndarray) -> tuple[str, ...]:
    return tuple(compress(names, chosen.tolist()))
