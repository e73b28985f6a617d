"""Verdicts on healthy bodies outside of what was learned: how often one is taken for broken, and which part is blamed.

    python -m studies.accuracy.outside [--seeds 3] [--rows musashi]

The models and rows are those of `studies.accuracy.certainty`: states with a joint in the half of its range that was not
learned, another trajectory, or the last part of a recording. Windows of ten successive rows outside are judged as they
are, and with a lie: one element, drawn at random, is off by `LIE` in all of them.

The second table is of the test for lying sensors in healthy motion, half of which is in the unknown half of a joint.
"""

import argparse
from collections import Counter
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.anomaly.verdict import judge
from gemuco.anomaly.window import scores
from gemuco.schema import BodySchema
from gemuco.trust.config import BLOCK
from gemuco.trust.monitor import TrustMonitor
from studies.accuracy.certainty import Case, cases, train
from studies.bodies.lying_robots import NOISE, RATE, motion_of
from studies.peers.question import MissingData
from studies.peers.robots import robot_of

LENGTH, MOST = 10, 40
"""Rows of a window, and largest number of windows of a condition."""
TOOLS, PART = 3, round(BLOCK * RATE)
"""Number of tools, and samples of a block of the second table."""
LIE = 1.0
"""A wrong element is off by this [standard deviations]."""


def verdicts(case: Case, seed: int) -> tuple[float, Counter[str], Counter[str]]:
    """Train, and judge the rows outside.

    Returns:
        Share of the rows above the threshold, and how often each verdict was made of windows as they are, and with a
        lie.
    """
    trial = case.trial(seed)
    schema, _ = train(case, trial, seed)
    random, above = np.random.default_rng(seed), list[float]()
    healthy, lying = Counter[str](), Counter[str]()
    for condition, values in trial.test.items():
        under = schema.under(condition) if condition in schema.biases else schema
        rows = under.layout.join({name: values[name] for name in under.layout.names})
        away = np.flatnonzero(~case.inside(seed, values))
        if not len(away):
            continue
        above.append(float((scores(under, under.scaler.normalise(rows[away])) > _threshold(under)).mean()))
        for window in _windows(away):
            healthy[_kind(under, rows[window])] += 1
            wrong = rows[window].copy()
            element = random.integers(under.layout.size)
            wrong[:, element] += random.choice([-LIE, LIE]) * under.scaler.std[element]
            lying[_kind(under, wrong)] += 1
    return float(np.mean(above)), healthy, lying


def wrong_verdicts(case: Case, seed: int) -> tuple[int, float]:
    """Train, and return how many right elements are hidden in motion with three tools, and its length [min]."""
    name = case.name.partition(",")[0]
    schema, _ = train(case, case.trial(seed), seed)
    robot, number, blocks = robot_of(name), 0, 0
    for index, condition in enumerate(list(robot.conditions)[:TOOLS]):
        under = schema.under(condition)
        motion = motion_of(name, robot, condition, 100 + index)
        samples = under.scaler.normalise(under.layout.join(motion))
        monitor, before = TrustMonitor(under), frozenset[int]()
        for part in np.split(samples, np.arange(PART, len(samples), PART)):
            monitor.add(part, blocks * BLOCK)
            number += len(monitor.hidden - before)
            before, blocks = monitor.hidden, blocks + 1
    return number, blocks * BLOCK / 60.0


def _threshold(schema: BodySchema) -> float:
    """Return the threshold; NaN if there were too few samples to learn what is normal."""
    return float("nan") if schema.normal is None else schema.normal.threshold


def _windows(places: np.ndarray) -> Iterator[np.ndarray]:
    """Yield windows of successive places, evenly thinned."""
    windows = [places[i : i + LENGTH] for i in range(0, len(places) - LENGTH + 1, LENGTH)]
    yield from windows[:: max(1, -(-len(windows) // MOST))]


def _kind(schema: BodySchema, rows: np.ndarray) -> str:
    return judge(schema, [schema.layout.split(row) for row in rows]).kind or "none"


def _words(counts: Counter[str]) -> str:
    return ", ".join(f"{number} {kind}" for kind, number in counts.most_common())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--rows", default="", help="only bodies whose name contains this")
    arguments = parser.parse_args()
    table = Table("body", "rows above the threshold", "verdicts, healthy", f"with a lie of {LIE:g} std")
    for case in cases():
        if arguments.rows not in case.name or case.name.endswith(", all"):
            continue
        try:
            results = [verdicts(case, seed) for seed in range(arguments.seeds)]
        except MissingData as error:
            Console().print(f"{case.name}: {error}", style="dim")
            continue
        share = np.mean([above for above, _, _ in results])
        healthy = sum((result[1] for result in results), Counter[str]())
        lying = sum((result[2] for result in results), Counter[str]())
        table.add_row(case.name, f"{share:.0%}", _words(healthy), _words(lying))
    Console(width=150).print(table)
    table = Table("body", "right elements hidden", "healthy motion")
    for case in cases():
        if (
            case.name.endswith("half of a joint")
            and case.name.partition(",")[0] in NOISE
            and arguments.rows in case.name
        ):
            numbers, minutes = zip(*(wrong_verdicts(case, seed) for seed in range(arguments.seeds)), strict=True)
            table.add_row(case.name, str(sum(numbers)), f"{sum(minutes):.0f} min")
    Console(width=150).print(table)
