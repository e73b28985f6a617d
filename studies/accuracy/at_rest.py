"""Healthy bodies that stand still, move slowly, or move as they learned: how often one is taken for broken.

    python -m studies.accuracy.at_rest [--robots kxr_humanoid pr2_duster musashi_arm kuka pam_arm car] [--count 60]

Models and motion are those of `studies.accuracy.lies`. A window has as many samples as the anomaly loop looks at, 0.1 s
apart. At rest all samples are one posture; slow motion goes through a tenth of the samples. The humanoid and the PR2
have fresh sensor noise in every sample; other bodies repeat what was measured. A lie is an offset of one element, drawn
at random, in all samples. `in full` judges the same windows as if all samples were of a moving body, as before.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco import BodySchema
from gemuco.anomaly.window import window_score
from services.model.anomaly_loop import APART, WINDOWS
from studies.accuracy.lies import RATE, Body, body_of, under
from studies.bodies.lying_robots import BODIES, NOISE, forecast_of
from studies.peers.robots import robot_of

STEP, LENGTH = round(APART * RATE), WINDOWS[-1]
"""Samples between two of a window, and number of samples of the longest."""
PACES = {"at rest": 0.0, "slow": 0.1, "moving": 1.0}
LIES = (0.0, 0.3, 1.0)
"""Offsets of a lying element [standard deviations]."""
STILL = 0.2
"""A pneumatic arm counts as resting where all velocities are below this [standard deviations]."""


def quiet_motion(name: str, body: Body) -> dict[str, np.ndarray]:
    """Return the motion without sensor noise, where that is known [standard deviations]."""
    if name not in NOISE:
        return body.motion
    layout = body.schema.layout
    motion = {c: forecast_of(robot_of(name), c, 100 + i) for i, c in enumerate(body.motion)}
    return {c: under(body.schema, c).scaler.normalise(layout.join(rows)) for c, rows in motion.items()}


def windows(
    name: str, body: Body, pace: float, count: int, random: np.random.Generator
) -> Iterator[tuple[BodySchema, np.ndarray]]:
    """Yield models and healthy windows [standard deviations], shape (LENGTH, size)."""
    layout, scaler = body.schema.layout, body.schema.scaler
    noise = np.zeros(layout.size)
    if name in NOISE:
        noise = np.concatenate([np.full(s.size, NOISE[name][s.name]) for s in layout.signals]) / scaler.std
    motion = quiet_motion(name, body)
    for condition, rows in motion.items():
        places = np.arange(len(rows) - LENGTH * STEP)
        if pace == 0.0 and "joint_velocity" in layout.names:
            still = np.abs(rows[:, layout.slice("joint_velocity")]).max(axis=1) < STILL
            places = places[still[places]]
        for place in random.choice(places, min(len(places), -(-count // len(motion))), replace=False):
            at = place + (np.arange(LENGTH) * STEP * pace).astype(int)
            yield under(body.schema, condition), rows[at] + noise * random.standard_normal((LENGTH, layout.size))


def is_odd(schema: BodySchema, rows: np.ndarray) -> bool:
    """Whether one of the windows that the anomaly loop looks at is further from normal than a healthy body's."""
    return any(window_score(schema, rows[-count:]) > 1.0 for count in WINDOWS)


def in_full(schema: BodySchema) -> BodySchema:
    """Return a model for which every window counts as one of a moving body."""
    normal = schema.normal
    assert normal is not None and normal.windows is not None
    return schema.with_normal(replace(normal, windows=replace(normal.windows, scatter=None)))


def shares(name: str, body: Body, pace: float, count: int) -> list[tuple[float, float]]:
    """Return the share of odd windows, and that if they count in full, for every lie."""
    random = np.random.default_rng(3)
    results = []
    for lie in LIES:
        odd = []
        for schema, rows in windows(name, body, pace, count, random):
            rows[:, random.choice(body.columns)] += lie * random.choice([-1.0, 1.0])
            odd.append((is_odd(schema, rows), is_odd(in_full(schema), rows)))
        results.append(tuple(np.mean(odd, axis=0)))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=list(BODIES))
    parser.add_argument("--count", type=int, default=60, help="windows of each pace and lie")
    arguments = parser.parse_args()
    names = ["healthy", *(f"off by {lie:g} std" for lie in LIES[1:])]
    table = Table("body", "pace", *(f"{name}: odd, in full" for name in names))
    for robot in arguments.robots:
        body = body_of(robot)
        for words, pace in PACES.items():
            cells = [f"{new:.0%}, {old:.0%}" for new, old in shares(robot, body, pace, arguments.count)]
            table.add_row(robot, words, *cells)
    Console(width=150).print(table)
