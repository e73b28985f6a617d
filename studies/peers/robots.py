"""Simulated robots: states of the designer's robot, with and without the noise of its sensors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from gemuco import TrainConfig
from hal import registry
from hal.config import RobotConfig, load_robot
from services.learning.motion import Forecast
from services.learning.trainer import train_config
from services.model.artifacts import robot_file
from services.model.living_model import layout_of
from services.model.model_config import collect_config, model_config
from studies.peers.question import Bar, Body, Question, Rows, Trial

JOINTS, TIP, CENTER, PIXEL = "joint_position", "tool_tip_position", "center_of_gravity", "tool_tip_pixel"
TENSION, LENGTH = "muscle_tension", "muscle_length"
NOISE = {
    "kxr_humanoid": {JOINTS: 2e-3, CENTER: 0.2e-3, TIP: 2e-3, PIXEL: 1.0},
    "pr2_duster": {JOINTS: 0.5e-3, TIP: 5e-3},
    "musashi_arm": {JOINTS: 1e-3, TENSION: 0.5, LENGTH: 0.05e-3},
}
"""Standard deviations of the sensors [rad, m, px, N] are those of the actual variants in `simulators`; 0.03 N at the
eight cells of the humanoid's feet are 0.2 mm of its center of gravity."""
EPISODE = 10
"""Samples of an episode; states are independent of each other."""
TEST = {"kxr_humanoid": 100, "pr2_duster": 60, "musashi_arm": 1000}
"""Test rows per condition."""
FRESH = 10_000
"""Offset of the seed of test rows."""
NOISY, EXACT = Bar("best", 1.10), Bar("gaussian_process", 3.0)


@cache
def robot_of(name: str) -> RobotConfig:
    """Return the shipped robot file's content."""
    return load_robot(Path(robot_file(name)))


def states(name: str, condition: str, count: int, seed: int) -> Rows:
    """Draw states of the designer's robot within its limits and constraints [unit of each signal]."""
    robot = robot_of(name)
    collect = collect_config(robot)
    if collect.states is not None:
        rows: Rows = registry.load_object(collect.states)(robot, count, seed)
        return rows
    random = np.random.default_rng([seed, list(robot.conditions).index(condition)])
    limits, low_high = Forecast(robot, collect, condition), robot.bounds(JOINTS)
    safe = np.zeros((0, len(low_high[0])))
    while len(safe) < count:
        drawn = random.uniform(*low_high, (4 * count, len(low_high[0])))
        safe = np.concatenate([safe, drawn[~limits.outside(drawn).any(axis=1)]])
    forecast = registry.load_object(str(collect.forecast))(robot, condition, safe[:count])
    return {signal: np.asarray(forecast[signal], float) for signal in layout_of(robot).names}


def with_noise(name: str, rows: Rows, random: np.random.Generator) -> Rows:
    """Return rows as the robot's sensors measure them."""
    noise = NOISE[name]
    return {signal: values + noise[signal] * random.standard_normal(values.shape) for signal, values in rows.items()}


def trial(name: str, noisy: bool, seed: int) -> Trial:
    """Draw training episodes and test rows of every condition."""
    robot = robot_of(name)
    random = np.random.default_rng([seed, 77])
    train: dict[str, Sequence[Rows]] = {}
    test: dict[str, Rows] = {}
    for condition in robot.conditions or ("default",):
        rows = states(name, condition, collect_config(robot).samples, seed)
        fresh = states(name, condition, TEST[name], seed + FRESH)
        if noisy:
            rows, fresh = with_noise(name, rows, random), with_noise(name, fresh, random)
        count = len(rows[JOINTS])
        train[condition] = [
            {signal: values[first : first + EPISODE] for signal, values in rows.items()}
            for first in range(0, count, EPISODE)
        ]
        test[condition] = fresh
    return Trial(train, test)


def settings(name: str, seed: int) -> TrainConfig:
    """Return the training settings of the robot file."""
    model = model_config(robot_of(name))
    return train_config(model, model.training.epochs, seed)


@dataclass(frozen=True, slots=True)
class Questions:
    """Questions to one robot: masks that one model serves, outputs, and (target, given, unit, scale) of every row."""

    masks: Sequence[Sequence[str]]
    outputs: Sequence[str] | None
    asked: Sequence[tuple[str, tuple[str, ...], str, float]]
    bars: Mapping[str, Bar]


KXR = Questions(
    masks=[
        (JOINTS, CENTER, TIP),
        (JOINTS, CENTER, PIXEL),
        (JOINTS, TIP, PIXEL),
        (CENTER, TIP, PIXEL),
        (JOINTS, TIP),
        (JOINTS, CENTER),
        (JOINTS, PIXEL),
        (JOINTS,),
    ],
    outputs=None,
    asked=[
        (TIP, (JOINTS,), "mm", 1e3),
        (CENTER, (JOINTS,), "mm", 1e3),
        (PIXEL, (JOINTS,), "px", 1.0),
        (JOINTS, (CENTER, TIP, PIXEL), "rad", 1.0),
        (TIP, (JOINTS, CENTER, PIXEL), "mm", 1e3),
    ],
    bars={},
)
"""The masks are the paper's eight, which structure determination finds on this robot (docs/results_experiments.md)."""
PR2 = Questions([(JOINTS,)], (TIP,), [(TIP, (JOINTS,), "mm", 1e3)], {})
MUSASHI = Questions(
    masks=[(JOINTS, TENSION), (TENSION, LENGTH), (JOINTS, LENGTH), (JOINTS, TENSION, LENGTH)],
    outputs=None,
    asked=[
        (JOINTS, (TENSION, LENGTH), "rad", 1.0),
        (LENGTH, (JOINTS, TENSION), "mm", 1e3),
        (TENSION, (JOINTS, LENGTH), "N", 1.0),
    ],
    bars={JOINTS: Bar("at most", 0.02)},
)
"""The masks are those that the robot file's thresholds allow on most seeds."""
ROBOTS = {"kxr_humanoid": KXR, "pr2_duster": PR2, "musashi_arm": MUSASHI}


def bodies() -> list[Body]:
    """Return every robot without and with noise."""
    return [_body(name, noisy) for name in ROBOTS for noisy in (False, True)]


def _body(name: str, noisy: bool) -> Body:
    questions, layout = ROBOTS[name], layout_of(robot_of(name))
    make: Callable[[int], Trial] = partial(trial, name, noisy)

    def bar(target: str) -> Bar:
        return NOISY if noisy else questions.bars.get(target, EXACT)

    return Body(
        name=f"{name}, {'noise of its sensors' if noisy else 'no noise'}",
        units={signal.name: signal.unit for signal in layout.signals},
        trial=make,
        questions=[
            Question(f"{target} from {' + '.join(given)}", target, given, shown, scale, bar(target))
            for target, given, shown, scale in questions.asked
        ],
        settings=partial(settings, name),
        settings_name="robot file",
        masks=questions.masks,
        outputs=questions.outputs,
    )
