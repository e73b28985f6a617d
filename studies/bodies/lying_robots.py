"""Models and healthy motion of the robots of `studies.accuracy.lies`."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from gemuco import BodySchema
from gemuco.dataset import Dataset, Episode
from hal import registry
from hal.config import RobotConfig, load_robot
from services.learning.motion import Forecast, random_postures
from services.learning.trainer import train_config
from services.model.living_model import layout_of
from services.model.model_config import collect_config, model_config
from studies.bodies import vehicle
from studies.bodies.actual_arms import record

Rows = dict[str, np.ndarray]
Motion = dict[str, Rows]
JOINTS, TIP, CENTER, PIXEL = "joint_position", "tool_tip_position", "center_of_gravity", "tool_tip_pixel"
TENSION, LENGTH = "muscle_tension", "muscle_length"
NOISE = {
    "kxr_humanoid": {JOINTS: 2e-3, CENTER: 0.2e-3, TIP: 2e-3, PIXEL: 1.0},
    "pr2_duster": {JOINTS: 0.5e-3, TIP: 5e-3},
}
"""Standard deviations of the sensors [rad, m, px] are those of the actual variants in `simulators`."""
MASKS = {
    "kxr_humanoid": [
        (JOINTS, CENTER, TIP), (JOINTS, CENTER, PIXEL), (JOINTS, TIP, PIXEL), (CENTER, TIP, PIXEL), (JOINTS, TIP),
        (JOINTS, CENTER), (JOINTS, PIXEL), (JOINTS,),
    ],
    "pr2_duster": [(JOINTS,)],
}  # fmt: skip
MUSCLES = [(JOINTS, TENSION), (TENSION, LENGTH), (JOINTS, LENGTH), (JOINTS, TENSION, LENGTH)]
SECONDS, RATE = 240, 50
"""Length [s] and rate [Hz] of the motion of each condition."""
DRIVEN, DRIVES = 1200.0, 5.0
"""Length [s] and rate [Hz] of the drive that a model of the car is learned from."""
ARM, LIVED, JUDGED = 921, 400.0, 300.0
"""Number of the muscle-driven arm, and the lengths [s] of the motion to learn from and of that to judge."""
PAM_LEARNED, PAM_JUDGED = slice(0, 400), slice(800, 1300)
"""Episodes of the arm with pneumatic muscles, every second row of them; its rate is not known."""
PAM_UNITS = "rad", "rad/s", "1", "1"
"""Units of its positions, velocities, pressures and commanded pressures, which the publishers normalised."""


def _robot(name: str) -> RobotConfig:
    return load_robot(Path("robots") / f"{name}.yaml")


def _noisy(name: str, rows: Rows, draw: np.random.Generator) -> Rows:
    return {signal: value + NOISE[name][signal] * draw.standard_normal(value.shape) for signal, value in rows.items()}


def _postures(robot: RobotConfig, condition: str, count: int, seed: int) -> np.ndarray:
    """Return random joint positions within limits and constraints [rad], shape (count, n)."""
    draw = np.random.default_rng([seed, list(robot.conditions).index(condition)])
    limits, (low, high) = Forecast(robot, collect_config(robot), condition), robot.bounds(JOINTS)
    safe = np.zeros((0, len(low)))
    while len(safe) < count:
        drawn = draw.uniform(low, high, (4 * count, len(low)))
        safe = np.concatenate([safe, drawn[~limits.outside(drawn).any(axis=1)]])
    return safe[:count]


def _forecast(robot: RobotConfig, condition: str, postures: np.ndarray) -> Rows:
    rows = registry.load_object(str(collect_config(robot).forecast))(robot, condition, postures)
    return {signal: np.asarray(rows[signal], float) for signal in layout_of(robot).names}


def motion_of(name: str, robot: RobotConfig, condition: str, seed: int) -> Rows:
    """Return noisy samples of random motion with a tool."""
    return _noisy(name, forecast_of(robot, condition, seed), np.random.default_rng([seed, 5]))


def forecast_of(robot: RobotConfig, condition: str, seed: int) -> Rows:
    """Return the same samples without noise."""
    start, commands = _postures(robot, condition, 1, seed)[0], []
    for command, hold in random_postures(robot, collect_config(robot), condition, seed)(start):
        commands += [command] * max(1, round(hold * RATE))
        if len(commands) >= SECONDS * RATE:
            break
    return _forecast(robot, condition, np.array(commands[: SECONDS * RATE]))


def _with_tools(name: str, fit: Callable, config: Callable, learn: Callable) -> tuple[BodySchema, Motion]:
    robot, draw, train = _robot(name), np.random.default_rng([0, 77]), {}
    for condition in robot.conditions:
        rows = _forecast(robot, condition, _postures(robot, condition, collect_config(robot).samples, 0))
        rows = _noisy(name, rows, draw)
        train[condition] = [{s: v[i : i + 10] for s, v in rows.items()} for i in range(0, len(rows[JOINTS]), 10)]
    model = model_config(robot)
    units = {signal.name: signal.unit for signal in layout_of(robot).signals}
    outputs = (TIP,) if name == "pr2_duster" else None
    schema, _ = fit(train, train_config(model, model.training.epochs, 0), MASKS[name], x_out=outputs, units=units)
    return schema, {c: motion_of(name, robot, c, 100 + i) for i, c in enumerate(robot.conditions)}


def _arm(fit: Callable, config: Callable, learn: Callable) -> tuple[BodySchema, Motion]:
    robot = _robot("musashi_arm")
    lived, other = record(robot, ARM, 1, 10.0, LIVED), record(robot, ARM, 2, float(RATE), JUDGED)
    schema, _ = fit(Dataset(layout_of(robot), (Episode("default", lived),)), config(seed=0), MUSCLES)
    half = len(other[JOINTS]) // 2
    schema = schema.with_normal(learn(schema, schema.layout.join({s: v[:half:5] for s, v in other.items()})))
    return schema, {"": {s: v[half:] for s, v in other.items()}}


def _data(*names: str) -> Path:
    return Path(os.environ.get("GEMUCO_DATA", "../shared/data")).joinpath(*names)


def _kuka(fit: Callable, config: Callable, learn: Callable) -> tuple[BodySchema, Motion]:
    """Learn the two encoders of axes 1 to 3 from trajectory A, and judge B, 4 ms steps."""

    def rows(letter: str) -> Rows:
        with np.load(_data("kuka_kr300", f"trajectory_{letter}.npz")) as file:
            motor, second = (
                np.radians(file[key][:, :3].astype(float)) for key in ("act_pos_mot_deg", "act_pos_se_deg")
            )
        return {"motor_position": motor, "second_encoder": second}

    known, judged = rows("A"), rows("B")
    train = [{s: v[i : i + 100] for s, v in known.items()} for i in range(0, len(known["motor_position"]), 100)]
    masks = [("motor_position",), ("second_encoder",)]
    schema, _ = fit(train, config(seed=0), masks, units=dict.fromkeys(known, "rad"))
    return schema, {"": judged}


def _pam(fit: Callable, config: Callable, learn: Callable) -> tuple[BodySchema, Motion]:
    """Learn a real arm with eight pneumatic muscles from the first episodes of a day, and judge later ones."""
    names = JOINTS, "joint_velocity", "muscle_pressure", "pressure_command"
    with np.load(_data("pam_arm", "first_80_percent.npz")) as file:
        day = {name: file[name][::2].astype(float) for name in names}
        numbers = file["episode"][::2]
    order = np.unique(numbers)
    train = [{s: v[numbers == number] for s, v in day.items()} for number in order[PAM_LEARNED]]
    masks = [names[1:], names[1:3]]
    schema, _ = fit(train, config(seed=0), masks, x_out=(JOINTS,), units=dict(zip(names, PAM_UNITS, strict=True)))
    return schema, {"": {s: v[np.isin(numbers, order[PAM_JUDGED])] for s, v in day.items()}}


def _car(fit: Callable, config: Callable, learn: Callable) -> tuple[BodySchema, Motion]:
    schema, _ = fit([vehicle.drive(1, DRIVEN, DRIVES)], config(seed=0), vehicle.MASKS, units=vehicle.UNITS)
    return schema, {"": vehicle.drive(2, DRIVEN, float(RATE))}


BODIES: dict[str, Callable[..., tuple[BodySchema, Motion]]] = {
    "kxr_humanoid": partial(_with_tools, "kxr_humanoid"),
    "pr2_duster": partial(_with_tools, "pr2_duster"),
    "musashi_arm": _arm,
    "kuka": _kuka,
    "pam_arm": _pam,
    "car": _car,
}
"""Robot -> function of `fit`, `TrainConfig` and `learn_normal` that returns model and healthy motion by condition."""
