"""False alarms on a changed body, whose normal errors are learned anew from little motion after an update.

    python -m studies.accuracy.changed_body [--arms 931 932 933 934 935]

The model of the designer's muscle-driven arm adapts to 20 s of the random motion of an actual arm. What is normal is
learned from the next samples (10 Hz), and 200 s of other healthy motion are judged: single samples, windows of 1 s, and
samples in which one encoder is lost. Then the same with each of three muscles cut.
"""

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.adaption.adapt import adapt
from gemuco.anomaly.healthy import learn_normal
from gemuco.anomaly.prediction import judgements
from gemuco.anomaly.verdict import window_score
from gemuco.anomaly.window import scores
from gemuco.schema import BodySchema
from hal.config import RobotConfig, load_robot
from studies.bodies.actual_arms import model, record

RATE = 10.0
ADAPTED, NORMAL, HEALTHY, CUT, SETTLED = 20.0, 100.0, 200.0, 60.0, 2.0
"""Lengths of the motions [s]; the first part of that with a cut muscle is not judged."""
COUNTS = (100, 200, 400, 1000)
"""Samples that the normal errors are learned from."""
MUSCLES = ("deltoid_side", "biceps", "pectoral")
WINDOW = 10
LOST = "joint_position"


def alarms(schema: BodySchema, rows: np.ndarray, lost: int | None = None) -> float:
    """Return the share of samples [unit], shape (n, size), above the threshold, with an element missing or none."""
    x = schema.scaler.normalise(rows)
    if lost is not None:
        x[:, lost] = np.nan
    return float(np.mean(scores(schema, x) > judgements(schema)(np.isfinite(x[0])).threshold))


def window_alarms(schema: BodySchema, rows: np.ndarray) -> float:
    """Return the share of windows of 1 s that are further from normal than a healthy body's."""
    x = schema.scaler.normalise(rows)
    return float(np.mean([window_score(schema, x[end - WINDOW : end]) > 1.0 for end in range(WINDOW, len(x), 5)]))


def judge(robot: RobotConfig, schema: BodySchema, arm: int) -> np.ndarray:
    """Return the shares of alarms on one arm, shape (counts, 6): the promised bound, then the columns of the table."""
    layout = schema.layout

    def rows(motion: int, duration: float, part: str = "") -> np.ndarray:
        return layout.join(record(robot, arm, motion, RATE, duration, part))

    schema = adapt(schema, [layout.split(row) for row in rows(1, ADAPTED)[::2]])
    normal, healthy = rows(2, NORMAL), rows(3, HEALTHY)
    cut = [rows(4, CUT, f"muscle_cut:{muscle}")[round(SETTLED * RATE) :] for muscle in MUSCLES]
    encoders = range(*layout.slice(LOST).indices(layout.size))
    result = []
    for count in COUNTS:
        learned = learn_normal(schema, normal[:count])
        one = schema.with_normal(learned)
        lost = np.mean([alarms(one, healthy, encoder) for encoder in encoders])
        noticed = [np.mean([judged(one, part) for part in cut]) for judged in (alarms, window_alarms)]
        result.append([learned.bound, alarms(one, healthy), window_alarms(one, healthy), lost, *noticed])
    return np.array(result)


def main() -> None:
    """Read the arguments, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, nargs="+", default=[931, 932, 933, 934, 935])
    arms = parser.parse_args().arms
    console, robot = Console(width=150), load_robot(Path("robots/musashi_arm.yaml"))
    schema = model(robot, console)
    shares = np.array([judge(robot, schema, arm) for arm in arms])
    table = Table(
        "normal samples", "bound", "alarms: samples", "windows of 1 s", "samples, an encoder lost", "cut: samples",
        "windows of 1 s", title=f"arms {arms}, mean and worst",
    )  # fmt: skip
    for index, count in enumerate(COUNTS):
        cells = shares[:, index]
        table.add_row(str(count), *(f"{cell.mean():.1%} ({cell.max():.1%})" for cell in cells.T))
    console.print(table)


if __name__ == "__main__":
    main()
