"""Sensors that lie: how many are found, how soon, which element is hidden, and what an ordinary threshold finds.

    python -m studies.accuracy.lies [--robots kxr_humanoid pr2_duster musashi_arm kuka pam_arm car] [--kinds swapped]
        [--seeds 6] [--first 1000] [--healthy]

Each robot moves at random: the humanoid and the PR2 by the designer's forecast with the noise of their sensors, the
muscle-driven arm in simulated physics with friction; the KUKA is a recording of a real robot, five times slower, and
`pam_arm` one of a real arm with eight pneumatic muscles, at a rate that is not known and taken for 50 Hz. Models
are trained once and kept in runs/lies. A lie begins after 20 s in an element drawn by the seed and lasts for 8 s. Its
size is in standard errors of the healthy prediction: the error of the model's estimate of this element while it is
hidden, on healthy motion (for recorded robots that of the watch). The other method is ridge regression of each element
on all others, learned from the same normal samples, with the largest error of the healthy motion that is judged as the
threshold (so it raises no false alarm in it), and the largest multiple of it as the culprit.
"""

import argparse
import pickle
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco import BodySchema, TrainConfig, fit
from gemuco.anomaly.healthy import learn_normal
from gemuco.estimation import fill
from gemuco.trust.monitor import TrustMonitor
from gemuco.trust.relations import Relations, rows_of
from studies.bodies.lying_robots import BODIES, Motion

RATE, BEFORE, AFTER = 50, 20, 8
"""Samples per second, and seconds before and after a lie begins."""
PART = RATE // 10
SIZES = (3, 5, 10)
SIZED, WHOLE = ("offset", "drift", "gain", "noise"), ("frozen", "sign", "clipped", "wrap", "swapped")
VISIBLE = 5.0
"""A lie without a size begins when its error first has this number of standard errors."""
LATE = 2.0
"""After this time [s] a value that is wrong by more than three standard errors must not be passed on as measured."""
ANGLES = ("joint", "motor_position", "second", "steering")
"""Signals whose names begin so wrap at a whole turn."""
RECORDED = ("kuka", "pam_arm")
"""The sizes of lies of these robots are in errors of the watch, because not every element has an estimate."""
CACHE = Path("runs/lies")
Random = np.random.Generator
Normalised = dict[str, np.ndarray]
"""Condition -> samples [standard deviations], shape (n, size)."""


@dataclass(frozen=True, slots=True)
class Body:
    """A model, healthy motion [standard deviations] by condition, standard errors, and ridge regression."""

    schema: BodySchema
    motion: Normalised
    columns: np.ndarray
    error: np.ndarray
    ridge: np.ndarray
    limit: np.ndarray


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one lie: delay [s] (NaN: not found), whether alone or in a pair, and whether it leaked later."""

    delay: float
    alone: bool
    named: bool
    leaked: bool
    early: bool
    ridge: bool
    ridge_right: bool


def body_of(name: str) -> Body:
    """Return a body, from runs/lies if it was made before."""
    file = CACHE / f"{name}.pkl"
    if not file.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(BODIES[name](fit, TrainConfig, learn_normal)))
    schema, motion = pickle.loads(file.read_bytes())
    relations = Relations.of(schema)
    assert relations is not None
    columns = relations.columns[: relations.count]
    rows = {c: under(schema, c).scaler.normalise(schema.layout.join(values)) for c, values in motion.items()}
    error = _errors(schema, rows, relations) if name in RECORDED else _estimate_errors(schema, motion, columns)
    assert schema.normal is not None
    every = schema.normal.rows.astype(float)[:, columns]
    ridge = np.zeros((len(columns) + 1, len(columns)))
    for index in range(len(columns)):
        others = np.c_[np.delete(every, index, axis=1), np.ones(len(every))]
        solved = np.linalg.solve(others.T @ others + 1e-3 * np.eye(others.shape[1]), others.T @ every[:, index])
        ridge[:, index] = np.insert(solved, index, 0.0)
    limit = np.abs(ridge_errors(ridge, np.concatenate(list(rows.values()))[:, columns])).max(axis=0)
    return Body(schema, rows, columns, error, ridge, limit)


def under(schema: BodySchema, condition: str) -> BodySchema:
    """Return the model under a condition, if it was trained with conditions."""
    return schema.under(condition) if condition in schema.biases else schema


def ridge_errors(ridge: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the errors of ridge regression of block means, shape (blocks, elements)."""
    means = rows[: len(rows) // PART * PART].reshape(-1, PART, rows.shape[1]).mean(axis=1)
    return means - np.c_[means, np.ones(len(means))] @ ridge


def _errors(schema: BodySchema, rows: Normalised, relations: Relations) -> np.ndarray:
    relation, parts = relations.without(frozenset()), []
    for condition, x in rows.items():
        parts.append(relation.errors(relations.features(rows_of(under(schema, condition), x[::PART]))))
    return np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0))[: relations.count]


def _estimate_errors(schema: BodySchema, motion: Motion, columns: np.ndarray) -> np.ndarray:
    """Return the root mean square error of the estimate of each element while it is hidden [standard deviations]."""
    squares = np.zeros(len(columns))
    for number, column in enumerate(columns):
        errors = []
        for condition, values in motion.items():
            whole = under(schema, condition).layout.join(values)
            for row in whole[:: max(1, len(whole) * len(motion) // 400)]:
                hidden = row.copy()
                hidden[column] = np.nan
                hidden.setflags(write=False)
                errors.append(fill(under(schema, condition), hidden).value[column] - row[column])
        squares[number] = np.mean(np.square(errors))
    return np.sqrt(squares) / schema.scaler.std[columns]


def lie(
    kind: str, rows: np.ndarray, element: int, other: int, amount: float, schema: BodySchema, draw: Random
) -> np.ndarray:
    """Return rows [standard deviations] in which an element lies after `BEFORE` seconds."""
    wrong, begin, sign = rows.copy(), BEFORE * RATE, draw.choice([-1.0, 1.0])
    true, span = rows[begin:, element], slice(begin, None)
    time, std, mean = np.arange(len(true)) / RATE, schema.scaler.std, schema.scaler.mean
    if kind == "swapped":
        wrong[span, element] = (rows[span, other] * std[other] + mean[other] - mean[element]) / std[element]
        wrong[span, other] = (rows[span, element] * std[element] + mean[element] - mean[other]) / std[other]
        return wrong
    usual = rows[:begin, element]
    wrong[span, element] = {
        "offset": true + sign * amount,
        "drift": true + sign * amount * np.minimum(time / 2.0, 3.0),
        "gain": true + sign * amount / max(usual.std(), 1e-6) * (true - usual.mean()),
        "noise": true + amount * draw.standard_normal(len(true)),
        "frozen": np.full_like(true, true[0]),
        "sign": 2.0 * usual.mean() - true,
        "clipped": np.minimum(true, np.quantile(usual, 0.6)),
        "wrap": true + 2.0 * np.pi / std[element],
    }[kind]
    return wrong


def play(body: Body, kind: str, size: int, seed: int) -> Outcome | None:
    """Play one lie; None if the element moved too little for an error."""
    draw = np.random.default_rng([seed, *kind.encode(), size])
    condition = str(draw.choice(list(body.motion)))
    schema, whole = under(body.schema, condition), body.motion[condition]
    start = int(draw.integers(0, len(whole) - (BEFORE + AFTER) * RATE))
    rows = whole[start : start + (BEFORE + AFTER) * RATE]
    angles = [i for i, c in enumerate(body.columns) if schema.layout.element(int(c)).startswith(ANGLES)]
    index = int(draw.choice(angles)) if kind == "wrap" else int(draw.integers(len(body.columns)))
    element = int(body.columns[index])
    span = next(span for span in schema.layout.slices.values() if span.start <= element < span.stop)
    others = [i for i in range(span.start, span.stop) if i != element and i in body.columns]
    if kind == "swapped" and not others:
        return None
    other = int(draw.choice(others)) if others else element
    wrong = lie(kind, rows, element, other, size * body.error[index], schema, draw)
    lying = {element, other} if kind == "swapped" else {element}
    error = np.abs(wrong - rows)[:, element] / body.error[index]
    visible = np.flatnonzero(
        error >= 0.999 * (size if kind in ("offset", "drift", "gain") else VISIBLE if kind != "noise" else 1.0)
    )
    if not len(visible):
        return None
    begin, leaked, delay = visible[0] / RATE, False, np.nan
    named: frozenset[int] = frozenset()
    monitor, early = TrustMonitor(schema), False
    for number in range(len(wrong) // PART):
        monitor.add(wrong[number * PART : (number + 1) * PART], (number + 1) / 10.0)
        now, hidden = (number + 1) / 10.0, monitor.hidden
        early |= bool(hidden) and now <= BEFORE
        if hidden and now > BEFORE:
            delay = now - begin if np.isnan(delay) else delay
            named = hidden
        is_wrong = error[min((number + 1) * PART, len(error) - 1)] > 3.0
        leaked |= now > begin + LATE and is_wrong and not lying <= hidden
    multiple = np.abs(ridge_errors(body.ridge, wrong[BEFORE * RATE :, body.columns])) / body.limit
    alarm = np.flatnonzero(multiple.max(axis=1) > 1.0)
    blamed = {int(body.columns[multiple[alarm[0]].argmax()])} if len(alarm) else set()
    return Outcome(
        delay, named == lying, lying <= named and len(named) <= 2, leaked, early, bool(len(alarm)), bool(blamed & lying)
    )


def rows_of_table(name: str, kinds: Sequence[str], seeds: range) -> Iterator[tuple[str, ...]]:
    """Yield the rows of one robot."""
    body, outcomes = body_of(name), defaultdict(list)
    for kind in kinds:
        for size in SIZES if kind in SIZED else (0,):
            for seed in seeds:
                if (outcome := play(body, kind, size, seed)) is not None:
                    outcomes[kind, size].append(outcome)
    groups = {f"size {size}": [o for (_, s), os in outcomes.items() if s == size for o in os] for size in SIZES}
    groups |= {kind: [o for (k, s), os in outcomes.items() if k == kind and s != 3 for o in os] for kind in kinds}
    groups["all from size 5"] = [o for (_, s), os in outcomes.items() if s != 3 for o in os]
    for group, played in groups.items():
        if played:
            delays = [max(o.delay, 0.0) for o in played if not np.isnan(o.delay)]
            share = [f"{np.mean([getattr(o, key) for o in played]):.0%}" for key in ("alone", "named", "leaked")]
            ridge = [f"{np.mean([getattr(o, key) for o in played]):.0%}" for key in ("ridge", "ridge_right")]
            median = f"{np.median(delays):.1f} s" if delays else "-"
            yield name, group, str(len(played)), f"{len(delays) / len(played):.0%}", median, *share, *ridge


def healthy(name: str) -> str:
    """Return a sentence on the verdicts during healthy motion, with a change of tool between conditions."""
    body, verdicts, seconds, monitor = body_of(name), 0, 0.0, None
    for condition, rows in body.motion.items():
        schema = under(body.schema, condition)
        monitor = monitor or TrustMonitor(schema)
        before: frozenset[int] = frozenset()
        for number in range(len(rows) // PART):
            if number == 30:
                monitor.use(schema)  # p is recognised 3 s after the tool was changed
            monitor.add(rows[number * PART : (number + 1) * PART], seconds)
            seconds += 0.1
            verdicts += bool(monitor.hidden - before)
            before = monitor.hidden
    return f"{name}: {verdicts} wrong verdicts in {seconds / 60.0:.0f} min of healthy motion."


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=list(BODIES), choices=list(BODIES))
    parser.add_argument("--kinds", nargs="+", default=[*SIZED, *WHOLE], choices=[*SIZED, *WHOLE])
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first", type=int, default=1000, help="The first seed.")
    parser.add_argument("--healthy", action="store_true", help="Only count wrong verdicts during healthy motion.")
    options = parser.parse_args()
    console = Console(width=160)
    heads = ("robot", "lies", "n", "found", "median", "alone", "in a pair", "leaked", "ridge found", "ridge right")
    for robot in options.robots:
        console.print(healthy(robot))
        if not options.healthy:
            table = Table(*heads)
            for row in rows_of_table(robot, options.kinds, range(options.first, options.first + options.seeds)):
                table.add_row(*row)
            console.print(table)
