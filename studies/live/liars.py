"""Lies of sensors to a service that learns online: who is hidden, how soon, and who is hidden of a healthy robot.

    python -m studies.live.liars [--plays 12] [--first 0] [--kinds offset tool] [--still] [--some] [--ticks 4096]

A PR2 with a duster in its hand moves between random postures at random speeds, and rests between them. All loops of the
model service run at their own rates, `adapt` is on (off with `--still`), and the tool at the start is another one than
the service believes. After about half a minute one thing happens, and 25 s later the play ends:

    offset, frozen, drift   a drawn joint's encoder lies: by 0.1, 0.3 or 1 rad, or by no more motion
    tool, strange           another tool is in the hand at once, a trained one or one that was never trained
    none                    nothing

Encoders have no noise, and the camera reports 35 ms late. With `--some` half of the moves are of one to three joints
while the others rest, and `--ticks` is the number of values that an encoder has per turn. The model is trained once on
the designer's forecast without noise, and kept in runs/lies.
"""

import argparse
import logging
import pickle
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco import BodySchema, TrainConfig, fit
from gemuco.anomaly.healthy import learn_normal
from hal.config import RobotConfig, load_robot
from services.learning.motion import minimum_jerk, random_postures
from services.model.model_config import collect_config
from simulators.robots.pr2_duster.body import tool_tip
from simulators.robots.pr2_duster.duster import GRASPS
from studies.accuracy.lies import CACHE
from studies.bodies import lying_robots
from studies.live.service import LiveService

JOINTS, TIP = "joint_position", "tool_tip_position"
HAL_RATE, CAMERA_RATE, CAMERA_AGE = 50, 30, 0.035
"""Rates [Hz], and the age of the camera's values when they arrive [s]."""
STEP = 0.01
"""The motion is known at steps of this length [s]."""
EARLIEST, LATEST, AFTERWARDS = 25.0, 35.0, 25.0
"""The event comes between the first two times [s]; the play ends the third time [s] after it."""
SIZES = (0.1, 0.3, 1.0)
"""Sizes of offsets and drifts [rad]; a drift has its size after 2 s."""
LIES, HEALTHY = ("offset", "frozen", "drift"), ("none", "tool", "strange")
SOON = 2.0
"""A lie is to be hidden within this time [s]."""
WRONG = 0.05
"""A lie begins when its value is first wrong by this much [rad]: a frozen encoder of a joint at rest is right."""


@dataclass(frozen=True, slots=True)
class Play:
    """One play.

    Attributes:
        kind: What happens.
        liar: The lying element; empty if none lies.
        size: Size of the lie [rad].
        delay: Time from the event until the liar was hidden [s]; NaN if it never was.
        wrong: Right elements that were hidden at some time.
        stayed: Those that were hidden at the end.
        began: Time from the event until the value was wrong by `WRONG` [s]; NaN if it never was.
    """

    kind: str
    liar: str
    size: float
    delay: float
    wrong: frozenset[str]
    stayed: frozenset[str]
    began: float = 0.0


def motion(robot: RobotConfig, condition: str, seed: int, seconds: float, some: bool = False) -> np.ndarray:
    """Return joint positions [rad] every `STEP` of moves between random postures with rests, shape (n, joints).

    Args:
        robot: The robot.
        condition: The tool in its hand.
        seed: Draws postures, speeds and rests.
        seconds: Least length [s].
        some: Whether half of the moves are of one to three joints only.
    """
    draw, config = np.random.default_rng([seed, 9]), collect_config(robot)
    moves = random_postures(robot, config, condition, seed)(np.mean(robot.bounds(JOINTS), axis=0))
    goals = (goal for goal, hold in moves if hold == config.hold)  # every move ends with a rest
    parts = [next(goals)[None]]
    while sum(map(len, parts)) * STEP < seconds:
        rest = draw.choice([draw.uniform(0.1, 0.5), draw.uniform(1.0, 6.0)])
        parts.append(np.repeat(parts[-1][-1:], round(rest / STEP), axis=0))
        goal = next(goals)
        if some and draw.random() < 0.5:
            resting = draw.permutation(len(goal))[draw.integers(1, 4) :]
            goal = np.where(np.isin(np.arange(len(goal)), resting), parts[-1][-1], goal)
        parts.append(minimum_jerk(parts[-1][-1], goal, draw.uniform(0.3, 2.0), STEP))
    return np.concatenate(parts)


def play(
    robot: RobotConfig,
    schema: BodySchema,
    kind: str,
    seed: int,
    learns: bool = True,
    some: bool = False,
    ticks: int = 0,
) -> Play:
    """Play once; the seed draws motion, tools, the liar, and the time.

    Args:
        robot: The robot.
        schema: Its model.
        kind: What happens.
        seed: The seed.
        learns: Whether the service learns online.
        some: Whether half of the moves are of one to three joints only.
        ticks: Number of values that an encoder has per turn; any value by default.
    """
    draw = np.random.default_rng([seed, 3])
    condition, believed = (str(draw.choice(list(schema.biases))) for _ in range(2))
    joint, size = int(draw.integers(robot.signals[JOINTS].size)), float(draw.choice(SIZES))
    sign, begin = float(draw.choice([-1.0, 1.0])), float(draw.uniform(EARLIEST, LATEST))
    others = [name for name in GRASPS if (name in schema.biases) == (kind == "tool") and name != condition]
    true = motion(robot, condition, seed, begin + AFTERWARDS + 1.0, some)
    tip = tool_tip(GRASPS[condition], true)
    if kind in ("tool", "strange"):
        tip[round(begin / STEP) :] = tool_tip(GRASPS[str(draw.choice(others))], true[round(begin / STEP) :])
    shown = true.copy()
    lying = shown[round(begin / STEP) :, joint]
    lying[:] = {
        "offset": lying + sign * size,
        "frozen": np.full_like(lying, lying[0]),
        "drift": lying + sign * size * np.minimum(np.arange(len(lying)) * STEP / 2.0, 1.0),
    }.get(kind, lying)
    if ticks:
        shown = np.round(shown * ticks / (2.0 * np.pi)) * (2.0 * np.pi / ticks)
    is_wrong = np.abs(shown - true)[:, joint] >= WRONG
    began = float(is_wrong.argmax() * STEP - begin) if is_wrong.any() else np.nan
    service = LiveService(robot, schema.under(believed if learns else condition))
    if learns:
        service.model.update.adapt(True)
    liar = schema.layout.element(schema.layout.slice(JOINTS).start + joint) if kind in LIES else ""
    delay, wrong, hidden = np.nan, frozenset[str](), frozenset[str]()
    for time, values, age in arrivals(shown, tip, begin + AFTERWARDS):
        service.run_until(time)
        service.camera(values, age) if age else service.hal(values)
        hidden = frozenset(service.model.freshness.distrust.reasons)
        delay = time - begin if np.isnan(delay) and liar in hidden and time >= begin else delay
        wrong |= hidden - {liar}
    return Play(kind, liar, size, delay, wrong, hidden - {liar}, began)


def arrivals(joints: np.ndarray, tip: np.ndarray, end: float) -> Iterator[tuple[float, dict[str, np.ndarray], float]]:
    """Yield times of arrival [s], values, and the age of the camera's values [s], 0 for the HAL's, until a time [s]."""
    hal = ((n / HAL_RATE, {JOINTS: joints[round(n / HAL_RATE / STEP)]}, 0.0) for n in range(1, int(end * HAL_RATE)))
    shots = range(1, int((end - CAMERA_AGE) * CAMERA_RATE))
    seen = ((n / CAMERA_RATE + CAMERA_AGE, {TIP: tip[int(n / CAMERA_RATE / STEP)]}, CAMERA_AGE) for n in shots)
    yield from sorted([*hal, *seen], key=lambda arrival: arrival[0])


def model_of(name: str) -> BodySchema:
    """Return a model that was learned from the designer's forecast without noise, from runs/lies if it is there."""
    file = CACHE / f"{name}_without_noise.pkl"
    if not file.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        noise, lying_robots.NOISE[name] = lying_robots.NOISE[name], dict.fromkeys(lying_robots.NOISE[name], 0.0)
        file.write_bytes(pickle.dumps(lying_robots.BODIES[name](fit, TrainConfig, learn_normal)[0]))
        lying_robots.NOISE[name] = noise
    schema: BodySchema = pickle.loads(file.read_bytes())
    return schema


def row_of(kind: str, played: list[Play]) -> tuple[str, ...]:
    """Return the row of one kind; plays of a lie in which the value was never wrong do not count."""
    is_lie = kind in LIES
    counted = [play for play in played if not is_lie or play.began == play.began]
    delays = np.array([max(0.0, play.delay - play.began) for play in counted if play.delay == play.delay])
    return (
        kind,
        str(len(counted)),
        f"{len(delays)}" if is_lie else "-",
        f"{(delays <= SOON).sum()}" if is_lie else "-",
        f"{np.median(delays):.1f} s" if len(delays) else "-",
        str(sum(bool(play.wrong) for play in counted)),
        str(sum(bool(play.stayed) for play in counted)),
    )


def show(title: str, kinds: Iterable[str], seeds: range, play: Callable[[str, int], Play]) -> None:
    """Play every kind with every seed; print all plays and a table with a row per kind."""
    table = Table(title, "plays", "hidden", f"in {SOON:.0f} s", "median", "a right one hidden", "at the end")
    for kind in kinds:
        played = [play(kind, seed) for seed in seeds]
        table.add_row(*row_of(kind, played))
        for one in played:
            print(one, flush=True)
    Console(width=120).print(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plays", type=int, default=12, help="Plays of each kind.")
    parser.add_argument("--first", type=int, default=0, help="The first seed.")
    parser.add_argument("--kinds", nargs="+", default=[*LIES, *HEALTHY], choices=[*LIES, *HEALTHY])
    parser.add_argument("--still", action="store_true", help="Do not learn online; the service knows the tool.")
    parser.add_argument("--some", action="store_true", help="Half of the moves are of one to three joints only.")
    parser.add_argument("--ticks", type=int, default=0, help="Values per turn of an encoder; any value by default.")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    robot, schema = load_robot("robots/pr2_duster.yaml"), model_of("pr2_duster")
    seeds = range(options.first, options.first + options.plays)
    played = partial(play, robot, schema, learns=not options.still, some=options.some, ticks=options.ticks)
    show("what happens", options.kinds, seeds, played)
