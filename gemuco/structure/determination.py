"""Structure determination (paper, II-E): which signals can be inferred, and from which masks.

Up to 10 signals every mask is tried, and there are 2^n - 1 of them; with more the border between too little and enough
is searched for (`mask_search`). Either way a mask is feasible only if its own error was measured and is small enough.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import compress
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset
from gemuco.errors import NotEnoughData
from gemuco.learning.train import Progress, TrainConfig, Work, fit, together
from gemuco.masks import Mask, all_masks, bits, label
from gemuco.schema import BodySchema
from gemuco.signals import Layout
from gemuco.structure.mask_choice import choose
from gemuco.structure.mask_judge import SURE, Judge, Judged, Thresholds
from gemuco.structure.mask_search import find_border
from gemuco.structure.mask_training import LISTED, ROUNDS, training_masks

__all__ = ["Judge", "Structure", "Thresholds", "determine", "determining", "learn", "search", "select"]

MOST_MASKS = 64
"""A schema gets at most so many masks: each is trained, has its errors measured, and is looked at in every estimate."""
BUDGET = 20_000
"""About how many masks the search tries at most."""
OUTRIGHT = 5
"""Up to so many signals every mask is measured on all of them; those of more race."""
SHOWN = 40
"""Lines of the report's table of masks."""


@dataclass(frozen=True, slots=True)
class Structure:
    """What was determined.

    Attributes:
        layout: The signals it is about.
        x_in: Inputs, the union of the masks.
        x_out: Outputs.
        masks: Feasible masks for the schema, the best first; at most `MOST_MASKS`.
        L_i: Signal -> error when inferred from all others; infinite if no held-out sample tells.
        L_m: Mask -> error of x_out, of every mask that was tried.
        thresholds: What the errors were compared with.
        is_whole: Whether every mask was tried, or the search ended with nothing left to look at.
        rough: Masks whose L_m is an estimate from at least `HEATS[0]` rows of a split, in place of all that judge: it
            is further than `SURE` standard errors from the threshold. None of `masks` is.
    """

    layout: Layout
    x_in: tuple[str, ...]
    x_out: tuple[str, ...]
    masks: tuple[Mask, ...]
    L_i: dict[str, float]
    L_m: dict[Mask, float]
    thresholds: Thresholds
    is_whole: bool = True
    rough: frozenset[Mask] = frozenset()

    @property
    def feasible(self) -> tuple[Mask, ...]:
        """Every tried mask below the threshold, the best first."""
        return tuple(sorted((m for m in self.L_m if self.L_m[m] < self.thresholds.into), key=lambda m: self.L_m[m]))

    @property
    def listed(self) -> tuple[Mask, ...]:
        """The masks of the report: those of the smallest errors, at most `SHOWN`."""
        return tuple(sorted(self.L_m, key=lambda m: self.L_m[m])[:SHOWN])

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader of the tables may overlook, one sentence each."""
        found: list[str] = []
        for name in self.x_out:
            if all(name in m for m in self.masks):
                found.append(
                    f"'{name}' is an output, but no feasible mask does without it (threshold_in is lower than what it "
                    "needs): where it is missing it is estimated by descent on z."
                )
        for name in self.layout.names:
            if name not in self.x_in and name not in self.x_out:
                found.append(f"'{name}' is neither input nor output: the model does not use it.")
        if len(self.masks) < len(self.feasible):
            found.append(
                f"{len(self.feasible)} of {len(self.L_m)} tried masks are feasible; the {len(self.masks)} that serve "
                "random sets of available signals best are kept."
            )
        if self.rough:
            found.append(
                f"L_m of {len(self.rough)} masks, marked ~, is an estimate from few rows: they are further than "
                f"{SURE:g} standard errors from the threshold. That of the others, and so of all that are kept, is "
                "from all rows that judge."
            )
        if not self.is_whole:
            found.append("The search stopped at its budget: there may be feasible masks that it did not see.")
        return tuple(found)

    def report(self) -> str:
        """A table for people."""
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
            error = f"{'~' if m in self.rough else ''}{self.L_m[m]:.3f}"
            lines.append(f"{label(m, self.layout.names):<{width}}  {error:>7}  {answer}")
        if len(shown) < len(self.L_m):
            lines.append(f"and {len(self.L_m) - len(shown)} more")
        lines += ["", f"x_in  = {', '.join(self.x_in)}", f"x_out = {', '.join(self.x_out)}", *self.remarks]
        return "\n".join(lines)


def determine(
    dataset: Dataset,
    config: TrainConfig,
    thresholds: Thresholds | None = None,
    progress: Progress | None = None,
    splits: int = 1,
    drafts: Path | None = None,
) -> Structure:
    """Train once under all masks, measure masks on held-out episodes, and keep what can be inferred.

    Args:
        dataset: Episodes of one body.
        config: How to train.
        thresholds: When something counts as inferable; the paper's if not given.
        progress: Told the share done, 0 to 1, and a line of text.
        splits: How often to train, each time with other episodes held out; errors are means over all. One is the
            paper's way. Short recordings need more: which part is held out changes their errors many times over.
        drafts: A folder to keep trainings in, so that what was interrupted goes on; see `fit`.

    Raises:
        NotEnoughData: Too few samples or signals, a signal that never varies, or no signal or mask below its threshold.
    """
    return together([determining(dataset, config, thresholds, splits, drafts)], ROUNDS, progress)[0]


def learn(
    dataset: Dataset,
    config: TrainConfig | None = None,
    masks: Iterable[Iterable[str]] | None = None,
    x_out: Iterable[str] | None = None,
) -> BodySchema:
    """Learn a body from data (paper, II-D and II-E); `gemuco.learning.train.fit` also returns the history.

    Args:
        dataset: Episodes of one body.
        config: How to train; the defaults if not given.
        masks: The feasible masks; determined from the data if not given, and x_out with them.
        x_out: What to infer; every signal if masks are given and this is not.
    """
    config = config or TrainConfig()
    if masks is None:
        structure = determine(dataset, config)
        masks, x_out = structure.masks, x_out or structure.x_out
    return fit(dataset, config, masks, x_out=x_out)[0]


def determining(
    dataset: Dataset, config: TrainConfig, thresholds: Thresholds | None, splits: int, drafts: Path | None
) -> Work[Structure]:
    """`determine`, for whoever has the trainings done."""
    thresholds = thresholds or Thresholds()
    names = dataset.layout.names
    if len(names) < 2:
        raise NotEnoughData(
            f"There is one signal, '{names[0]}', and nothing to infer it from; structure needs at least two."
            if names
            else "There is no signal; structure determination needs at least two."
        )
    errors = yield from training_masks(dataset, config, splits, drafts)
    judge = Judge(names, errors, thresholds)
    if not judge.outputs.any():
        least = min(judge.L_i, key=lambda name: judge.L_i[name])
        raise NotEnoughData(
            f"No signal can be inferred from the others (smallest L_i {judge.L_i[least]:.3f} of '{least}', "
            f"threshold_out {thresholds.out:g}); collect more data or raise the threshold."
        )
    if len(names) <= LISTED:
        tried, is_whole = np.array([bits(m, names) > 0 for m in all_masks(names)]), True
    else:
        tried, is_whole = search(judge, config.seed)
    return select(dataset.layout, judge, tried, is_whole, config.seed)


def select(layout: Layout, judge: Judge, tried: np.ndarray, is_whole: bool, seed: int) -> Structure:
    """Measure masks, shape (n, signals), and keep those that are enough.

    Raises:
        NotEnoughData: None is.
    """
    names, thresholds = layout.names, judge.thresholds
    tried = tried[judge.is_judged(tried)]
    judged = judge.race(tried) if len(names) > OUTRIGHT else judge.of(tried)
    kept = _keep(judge, judged, seed)
    masks = [frozenset(_named(names, line)) for line in tried]
    return Structure(
        layout=layout,
        x_in=_named(names, tried[kept].any(axis=0)),
        x_out=_named(names, judge.outputs),
        masks=tuple(masks[index] for index in kept),
        L_i=judge.L_i,
        L_m={m: float(value) for m, value in zip(masks, judged.L_m, strict=True)},
        thresholds=thresholds,
        is_whole=is_whole,
        rough=frozenset(masks[index] for index in np.flatnonzero(judged.is_rough)),
    )


def _keep(judge: Judge, judged: Judged, seed: int) -> np.ndarray:
    """Indices of the masks to keep, the best first.

    Those of them that few rows told are measured on all rows, and `judged` says so.

    Raises:
        NotEnoughData: None is enough.
    """
    L_m, into = judged.L_m, judge.thresholds.into
    while True:
        feasible = np.flatnonzero(L_m < into)
        if not len(feasible):
            raise NotEnoughData(
                f"No mask is enough to infer x_out ({', '.join(_named(judge.names, judge.outputs))}): smallest L_m "
                f"{L_m.min():.3f}, threshold_in {into:g}; collect more data or raise the threshold."
            )
        candidates, errors = judged.masks[feasible], judged.squared[feasible]
        kept = feasible[choose(candidates, errors, judge.outputs, MOST_MASKS, seed)]
        judge.finish(judged, kept)
        if (L_m[kept] < into).all():
            return np.asarray(kept[np.argsort(L_m[kept], kind="stable")])


def search(judge: Judge, seed: int) -> tuple[np.ndarray, bool]:
    """The masks that the search found to be enough, and those just below; and whether it came to an end."""
    enough: list[np.ndarray] = []

    def is_enough(masks: np.ndarray) -> np.ndarray:
        judge.tried += len(masks)
        found = ~judge.is_judged(masks)  # what leaves nothing to infer is enough
        found[~found] = judge.race(masks[~found]).L_m < judge.thresholds.into
        enough.append(masks[found])
        return found

    border = find_border(is_enough, len(judge.names), BUDGET, seed)
    return np.concatenate([border.largest, *enough]), border.is_complete


def _named(names: tuple[str, ...], chosen: np.ndarray) -> tuple[str, ...]:
    return tuple(compress(names, chosen.tolist()))
