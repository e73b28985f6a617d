"""How true the intervals of estimates are: inside of the learned data, near their edge, and outside.

    python -m studies.accuracy.certainty [--seeds 5] [--rows kuka]

A model is trained on a part of the data and estimates every hidden output of other rows under every mask. Coverage is
the share of errors within 1.645 std; beside it are that of the expected error of the mask (one constant), of a constant
that covers 90 % of the held-out errors (split conformal), and of ridge regression's relative variance (leverage),
calibrated in the same way. Outside are states with a joint in the half of its range that was not learned, another
trajectory, or the last part of a recording. Recordings are those of `studies.peers` (GEMUCO_DATA).

The last table is of actual muscle-driven arms with the model of the designer's arm: `alone` is the coverage of the
model's std; `lost` that of the next 10 s, with the factor that a running service has when the sensor is lost; `late` is
the coverage in windows of 300 samples (30 s) with truth one second late.
"""

import argparse
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco import TrainConfig
from gemuco.certainty.certainty import NINETY, features
from gemuco.dataset import Dataset, Episode
from gemuco.estimation import fill
from gemuco.intervals.sureness import UNKNOWN
from gemuco.intervals.widening import RecentErrors, Widening
from gemuco.learning.accuracy import bias_of
from gemuco.learning.train import fit
from gemuco.masks import Mask
from gemuco.schema import BodySchema
from gemuco.signals import Layout, Signal
from studies.bodies.actual_arms import record
from studies.peers import recordings, robots
from studies.peers.question import MissingData, Trial

RIDGE = 1e-3
"""Regularisation of the leverage, as a share of the mean square of a feature."""
MOST = 2000
"""At most this many test rows are judged, thinned evenly."""
EDGE = 0.1
"""This share of the inner rows is nearest to the edge of the data."""


@dataclass(frozen=True, slots=True)
class Case:
    """A body, its data, and its settings.

    Attributes:
        name: Words for the table.
        units: Signal -> unit.
        trial: Seed -> data.
        masks: Masks of the model.
        outputs: Signals to infer; all if None.
        settings: Seed -> settings of the training.
        inside: Trial and rows -> which rows, of all signals [unit], are inside of the learned data.
    """

    name: str
    units: Mapping[str, str]
    trial: Callable[[int], Trial]
    masks: Sequence[Sequence[str]]
    outputs: Sequence[str] | None
    settings: Callable[[int], TrainConfig]
    inside: Callable[[int, Mapping[str, np.ndarray]], np.ndarray]


@dataclass(slots=True)
class Tally:
    """Errors of hidden outputs.

    Attributes:
        missed: Errors [standard deviations], one array per mask, shape (rows, elements).
        half: Method -> half the width of the interval [standard deviations], per mask.
        unknown: Whether the estimate was declared unknown, per mask, shape (rows,).
        groups: Name -> which rows belong to it, per mask.
    """

    missed: list[np.ndarray]
    half: dict[str, list[np.ndarray]]
    unknown: list[np.ndarray]
    groups: list[dict[str, np.ndarray]]

    def coverage(self, method: str, group: str) -> float:
        """Return the share of hits over all masks and elements; NaN without rows."""
        hits = [
            (np.abs(e) <= half)[of[group]]
            for e, half, of in zip(self.missed, self.half[method], self.groups, strict=True)
        ]
        flat = np.concatenate([part.ravel() for part in hits])
        return float(flat.mean()) if len(flat) else float("nan")

    def by_element(self, group: str) -> np.ndarray:
        """Return the coverage of every element of every mask, shape (n,)."""
        return np.concatenate([
            (np.abs(e) <= half)[of[group]].mean(axis=0)
            for e, half, of in zip(self.missed, self.half["std"], self.groups, strict=True)
        ])  # fmt: skip

    def errors(self, group: str, kept: bool) -> float:
        """Return the root mean square error [standard deviations], of all rows or those that are not unknown."""
        parts = [
            e[of[group] & (~unknown if kept else True)]
            for e, unknown, of in zip(self.missed, self.unknown, self.groups, strict=True)
        ]
        flat = np.concatenate([part.ravel() for part in parts])
        return float(np.sqrt(np.mean(flat**2))) if len(flat) else 0.0

    def share_unknown(self, group: str) -> float:
        """Return the share of rows that were declared unknown."""
        flat = np.concatenate([unknown[of[group]] for unknown, of in zip(self.unknown, self.groups, strict=True)])
        return float(flat.mean()) if len(flat) else float("nan")


def train(case: Case, trial: Trial, seed: int) -> tuple[BodySchema, Dataset]:
    """Return the model of a trial, and its held-out data."""
    episodes = [Episode(name, dict(rows)) for name, parts in trial.train.items() for rows in parts]
    first = episodes[0].values
    layout = Layout(tuple(Signal(name, first[name].shape[1], unit) for name, unit in case.units.items()))
    data, config = Dataset(layout, tuple(episodes)), case.settings(seed)
    schema, _ = fit(data, config, case.masks, x_out=case.outputs)
    return schema, data.split(config.held_out, config.seed)[1]


def judge(case: Case, seed: int) -> Tally:
    """Train, and estimate every hidden output of the test rows."""
    trial = case.trial(seed)
    schema, held = train(case, trial, seed)
    names = list(schema.biases)
    rows, owner, inside = [], [], []
    for condition, values in trial.test.items():
        count = len(next(iter(values.values())))
        thinned = np.linspace(0, count - 1, min(count, max(1, MOST // len(trial.test)))).astype(int)
        part = {name: values[name][thinned] for name in schema.layout.names}
        rows.append(np.concatenate(list(part.values()), axis=1))
        owner.append(np.full(len(thinned), names.index(condition) if names else 0))
        inside.append(case.inside(seed, part))
    tally = Tally([], {name: [] for name in ("std", "expected", "constant", "leverage")}, [], [])
    parts = np.concatenate(rows), np.concatenate(owner), np.concatenate(inside)
    for mask in schema.masks:
        if any(name not in mask for name in schema.x_out):
            _of_mask(schema, mask, held, parts, tally)
    return tally


def _of_mask(
    schema: BodySchema, mask: Mask, held: Dataset, parts: tuple[np.ndarray, np.ndarray, np.ndarray], tally: Tally
) -> None:
    """Judge one mask."""
    rows, owner, inside = parts
    layout, scale = schema.layout, schema.scaler.std
    hidden = [name for name in schema.x_out if name not in mask]
    places, given = layout.indices(hidden), layout.indices(mask)
    of_out = np.isin(schema.out_index, places)
    variants = [schema.under(name) for name in schema.biases] if len(schema.bias) else [schema]
    values, std, unknown = np.empty(rows.shape), np.empty(rows.shape), np.zeros(len(rows), bool)
    for index, row in enumerate(rows):
        joined = np.full(layout.size, np.nan)
        joined[given] = row[given]
        joined.setflags(write=False)
        completion = fill(variants[owner[index]] if len(schema.bias) else schema, joined)
        values[index], std[index] = completion.value, completion.std
        unknown[index] = completion.sureness[hidden[0]].state == UNKNOWN
    x = schema.scaler.normalise(rows)
    missed = ((values - rows) / scale)[:, places]
    errors, known = _held_errors(schema, mask, held)
    leverage, of_held = _leverage(known[:, given], x[:, given]), _leverage(known[:, given], known[:, given])
    share = np.quantile(np.abs(errors[:, of_out]) / np.sqrt(of_held)[:, None], 0.9, axis=0)
    tally.missed.append(missed)
    tally.half["std"].append(NINETY * (std / scale)[:, places])
    tally.half["expected"].append(
        np.tile(NINETY * (schema.errors["mask", mask] / scale[schema.out_index])[of_out], (len(rows), 1))
    )
    tally.half["constant"].append(np.tile(np.quantile(np.abs(errors[:, of_out]), 0.9, axis=0), (len(rows), 1)))
    tally.half["leverage"].append(np.sqrt(leverage)[:, None] * share)
    tally.unknown.append(unknown)
    tally.groups.append(_groups(schema, given, x, owner, inside))


def _held_errors(schema: BodySchema, mask: Mask, held: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of held-out rows under their own p, and the rows [standard deviations]."""
    x = schema.scaler.normalise(held.rows())
    names = list(schema.biases)
    own = np.array([names.index(name) if names else 0 for name in held.conditions])[held.condition_of_rows()]
    whole = np.isfinite(x).all(axis=1)
    x, p = x[whole], bias_of(schema, own[whole])
    return schema.infer(x, mask, p) - x[:, schema.out_index], x


def _leverage(known: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return 1 + phi inv(mean phi phi) phi / n of rows, shape (n,), with linear and squared features."""
    rows, phi = features(known), features(x)
    moments = rows.T @ rows / len(rows)
    moments += RIDGE * np.diag(moments).mean() * np.eye(len(moments))
    return np.asarray(1.0 + np.einsum("ij,jk,ik->i", phi, np.linalg.inv(moments), phi))


def _groups(
    schema: BodySchema, given: np.ndarray, x: np.ndarray, owner: np.ndarray, inside: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the rows inside, outside, nearest to the edge (by anchors, and by ranges), and of every condition."""
    anchors = schema.anchors[:, given].astype(float)
    distance = np.array([np.sort(((anchors - row[given]) ** 2).sum(axis=1))[:3].mean() for row in x])
    certainty = schema.certainty
    assert certainty is not None
    low, high = certainty.low[given], certainty.high[given]
    room = (np.minimum(x[:, given] - low, high - x[:, given]) / np.maximum(high - low, 1e-9)).min(axis=1)
    groups = {"inside": inside, "outside": ~inside}
    if inside.any():
        groups["edge"] = inside & (distance > np.quantile(distance[inside], 1.0 - EDGE))
        groups["rim"] = inside & (room < np.quantile(room[inside], EDGE))
    return groups | {f"condition {index}": inside & (owner == index) for index in np.unique(owner)}


def _half(trial: Callable[[int], Trial], joint: Callable[[int], tuple[int, float]], seed: int) -> Trial:
    """Return a trial that learns only rows with a joint below the middle of its range."""
    whole, (index, middle) = trial(seed), joint(seed)
    train: dict[str, Sequence[Mapping[str, np.ndarray]]] = {}
    for condition, episodes in whole.train.items():
        kept = [episode[robots.JOINTS][:, index] <= middle for episode in episodes]
        train[condition] = [
            {name: values[rows] for name, values in episode.items()}
            for episode, rows in zip(episodes, kept, strict=True)
            if rows.any()
        ]
    return Trial(train, whole.test)


def _thinned(trial: Callable[[int], Trial], most: int, seed: int) -> Trial:
    """Return a trial with at most this many rows to learn from, in whole episodes."""
    whole = trial(seed)
    count = sum(len(part[robots.JOINTS]) for parts in whole.train.values() for part in parts)
    every = max(1, round(count / most))
    return Trial({condition: parts[::every] for condition, parts in whole.train.items()}, whole.test)


def cases() -> Iterator[Case]:
    """Yield all bodies: the robots inside and with half of a joint's range held out, then the recordings."""
    for name, questions in robots.ROBOTS.items():
        units = {signal.name: signal.unit for signal in robots.layout_of(robots.robot_of(name)).signals}
        trial = partial(_thinned, partial(robots.trial, name, True), 5000)
        low, high = robots.robot_of(name).bounds(robots.JOINTS)
        middles = 0.5 * (low + high)

        def joint(seed: int, middles: np.ndarray = middles) -> tuple[int, float]:
            return seed % len(middles), float(middles[seed % len(middles)])

        def is_inside(
            seed: int, rows: Mapping[str, np.ndarray], joint: Callable[[int], tuple[int, float]] = joint
        ) -> np.ndarray:
            index, middle = joint(seed)
            return np.asarray(rows[robots.JOINTS][:, index] <= middle)

        settings = partial(robots.settings, name)
        shared = questions.masks, questions.outputs, settings
        yield Case(f"{name}, all", units, trial, *shared, _all)
        yield Case(f"{name}, half of a joint", units, partial(_half, trial, joint), *shared, is_inside)
    wanted = ("joint_capsule, last fifth", "joint_capsule, outer postures", "schunk_arm, a path",
              "kuka_kr300, axes 1 to 3, other trajectory", "pam_arm, last fifth of the day")  # fmt: skip
    for body in recordings.bodies():
        if body.name in wanted and body.masks is not None:
            yield Case(body.name, body.units, body.trial, body.masks, body.outputs, body.settings, _none)


def _all(_: int, rows: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.ones(len(next(iter(rows.values()))), bool)


def _none(_: int, rows: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.zeros(len(next(iter(rows.values()))), bool)


def _lines(name: str, tallies: Sequence[Tally]) -> Iterator[list[str]]:
    """Yield the rows of the table: coverage inside and outside, means over the seeds."""
    for group in ("inside", "edge", "rim", "outside"):
        has = [tally for tally in tallies if all(group in of for of in tally.groups)]
        if not has or np.isnan(has[0].coverage("std", group)):
            continue
        cells = [f"{np.mean([tally.coverage(m, group) for tally in has]):.3f}" for m in has[0].half]
        elements = np.concatenate([tally.by_element(group) for tally in has])
        within = np.mean([np.mean(np.abs(tally.by_element(group) - 0.9) <= 0.02) for tally in has])
        yield [
            name, group, *cells, f"{elements.min():.2f} to {elements.max():.2f}", f"{within:.0%}",
            f"{np.mean([tally.share_unknown(group) for tally in has]):.1%}",
            f"{np.mean([tally.errors(group, False) for tally in has]):.3f}",
            f"{max(tally.errors(group, True) for tally in has):.3f}",
        ]  # fmt: skip
    conditions = sorted({key for tally in tallies for key in tally.groups[0] if key.startswith("condition")})
    inner = [np.mean([tally.coverage("std", key) for tally in tallies]) for key in conditions]
    if len(conditions) > 1:
        yield [name, "by condition", f"{min(inner):.3f} to {max(inner):.3f}", *[""] * 8]


ACTUAL = "musashi_arm, actual arms"
RATE, LASTS, LATE, AHEAD, WINDOW = 10.0, 120.0, 10, 100, 300
"""Samples per second, length of a recording [s], lateness of the truth, and lengths of the future and of a window."""


def actual(seeds: int) -> Iterator[list[str]]:
    """Yield the rows of the last table."""
    case = next(case for case in cases() if case.name == "musashi_arm, all")
    schema, _ = train(case, case.trial(0), 0)
    robot = robots.robot_of("musashi_arm")
    for arm in range(1, seeds + 1):
        recording = record(robot, arm, arm, RATE, LASTS)
        rows = np.concatenate([recording[name] for name in schema.layout.names], axis=1)
        for name in (robots.JOINTS, robots.LENGTH):
            span, missed, std = schema.layout.slice(name), [], []
            for row in rows:
                hidden = row.copy()
                hidden[span] = np.nan
                hidden.setflags(write=False)
                completion = fill(schema, hidden)
                missed.append(completion.value[span] - row[span])
                std.append(completion.std[span])
            yield [f"arm {arm}, {name}", *_of_actual(np.array(missed), np.array(std))]


def _of_actual(missed: np.ndarray, std: np.ndarray) -> list[str]:
    """Return the coverage alone, after a loss, and with late truth, from errors and std, shape (samples, n)."""
    ahead, late = [], []
    recent, widening, pending = RecentErrors(missed.shape[1]), Widening(missed.shape[1]), deque[np.ndarray]()
    for index, (error, own) in enumerate(zip(missed, std, strict=True)):
        if index >= WINDOW and index % (AHEAD // 2) == 0 and index + AHEAD <= len(missed):
            after = slice(index, index + AHEAD)
            ahead.append(np.mean(np.abs(missed[after]) <= NINETY * recent.factor * std[after]))
        recent.see(error, own)
        promised = widening.factor * own
        late.append(np.abs(error) <= NINETY * promised)
        pending.append(promised)
        if len(pending) > LATE:
            widening.see(missed[index - LATE], pending.popleft(), LATE)
    sums = np.cumsum(np.array(late), axis=0)
    windows = (sums[WINDOW:] - sums[:-WINDOW]) / WINDOW
    alone = float(np.mean(np.abs(missed) <= NINETY * std))
    within = float(np.mean(np.abs(windows - 0.9) <= 0.03 + 1e-9))
    return [
        f"{alone:.3f}", f"{np.mean(ahead):.3f}", f"{np.min(ahead):.2f}", f"{windows.min():.2f} to {windows.max():.2f}",
        f"{within:.0%}",
    ]  # fmt: skip


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Coverage of the intervals of estimates")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds")
    parser.add_argument("--rows", default="", help="only bodies whose name contains this")
    options = parser.parse_args()
    console, begin = Console(width=200), time.monotonic()
    heads = ("body", "rows", "std", "expected error", "constant", "leverage", "by element", "in 0.90 +- 0.02",
             "unknown", "error [std]", "not unknown")  # fmt: skip
    table = Table(*heads)
    for case in cases():
        if options.rows not in case.name:
            continue
        try:
            tallies = [judge(case, seed) for seed in range(options.seeds)]
        except MissingData as error:
            console.print(f"{case.name}: {error}")
            continue
        for line in _lines(case.name, tallies):
            table.add_row(*line)
            console.print("  ".join(line), style="dim")
    console.print(table)
    if options.rows in ACTUAL:
        last = Table(ACTUAL, "alone", "lost, mean", "lost, worst", "late, windows", "late, in 0.90 +- 0.03")
        for cells in actual(options.seeds):
            last.add_row(*cells)
        console.print(last)
    console.print(f"{time.monotonic() - begin:.0f} s")


if __name__ == "__main__":
    main()
