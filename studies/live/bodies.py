"""Lies of sensors to a service that learns W online, on other bodies: how many are hidden, and which right ones are.

    python -m studies.live.bodies [--robots musashi_arm kxr_humanoid] [--plays 8] [--first 0] [--still]

Models, motion, and sizes of lies are those of `studies.accuracy.lies`, but all loops of the model service run at their
own rates, and `adapt` is on (off with `--still`). After 30 s an element drawn by the seed lies until the play ends
15 s later; its offset, or its drift after 2 s, has five or ten standard errors of the healthy prediction. Lies of the
kind `none` are healthy plays.
"""

import argparse
import logging
from functools import partial

import numpy as np

from hal.config import RobotConfig, load_robot
from studies.accuracy.lies import RATE, Body, body_of, under
from studies.live.liars import LIES, Play, show
from studies.live.service import LiveService

ROBOTS = "musashi_arm", "kxr_humanoid"
BEFORE, AFTERWARDS = 30, 15
"""Duration [s] before and after a lie begins."""
LATE = 2
"""Samples of a camera arrive this number of samples late."""
SIZES = 5, 10
"""Sizes of offsets and drifts [standard errors of the healthy prediction]."""


def play(robot: RobotConfig, body: Body, kind: str, seed: int, learns: bool = True) -> Play:
    """Play once; the seed draws the motion, the liar, and the size."""
    draw = np.random.default_rng([seed, *kind.encode()])
    condition, count = str(draw.choice(list(body.motion))), (BEFORE + AFTERWARDS) * RATE
    schema, rows = under(body.schema, condition), body.motion[condition]
    start, index = int(draw.integers(len(rows) - count)), int(draw.integers(len(body.columns)))
    element, size = int(body.columns[index]), float(draw.choice(SIZES)) * float(draw.choice([-1.0, 1.0]))
    shown = rows[start : start + count].copy()
    lying = shown[BEFORE * RATE :, element]
    lying[:] = {
        "offset": lying + size * body.error[index],
        "frozen": np.full_like(lying, lying[0]),
        "drift": lying + size * body.error[index] * np.minimum(np.arange(len(lying)) / RATE / 2.0, 1.0),
    }.get(kind, lying)
    service = LiveService(robot, schema)
    if learns:
        service.model.update.adapt(True)
    liar = schema.layout.element(element) if kind in LIES else ""
    delay, wrong, hidden = np.nan, frozenset[str](), frozenset[str]()
    samples, slices = schema.scaler.restore(shown), schema.layout.slices
    for number in range(1, count + 1):
        service.run_until(number / RATE)
        service.hal({name: samples[number - 1, span] for name, span in slices.items() if name not in robot.seen})
        if number > LATE and robot.seen:
            seen = {name: samples[number - 1 - LATE, slices[name]] for name in robot.seen}
            service.camera(seen, LATE / RATE)
        hidden = frozenset(service.model.freshness.distrust.reasons)
        delay = number / RATE - BEFORE if np.isnan(delay) and liar in hidden and number > BEFORE * RATE else delay
        wrong |= hidden - {liar}
    amount = abs(size) * float(body.error[index] * schema.scaler.std[element])
    return Play(kind, liar, amount, delay, wrong, hidden - {liar})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=ROBOTS)
    parser.add_argument("--plays", type=int, default=8, help="Plays of each kind.")
    parser.add_argument("--first", type=int, default=0, help="The first seed.")
    parser.add_argument("--kinds", nargs="+", default=[*LIES, "none"], choices=[*LIES, "none"])
    parser.add_argument("--still", action="store_true", help="Do not learn online.")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    for name in options.robots:
        robot, body = load_robot(f"robots/{name}.yaml"), body_of(name)
        seeds = range(options.first, options.first + options.plays)
        show(name, options.kinds, seeds, partial(play, robot, body, learns=not options.still))
