"""An actual arm: moved at random or to targets, recorded, and broken during the motion."""

from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from gemuco.controller import Controller
from gemuco.dataset import Dataset, Episode
from gemuco.signals import Layout, Signal
from hal import registry
from hal.config import RobotConfig
from services.hardware.stand_in import simulator_of
from services.learning.playground import CollectionStopped, DirectPlayground, Values
from services.model.living_model import layout_of
from simulators.direct import direct_robot

POSITION, TENSION, LENGTH = "joint_position", "muscle_tension", "muscle_length"
SENT = "sent_length"
"""Signal of a recording with the commanded wire lengths [m]."""
RATE = 10.0
"""Rate of recorded samples [Hz]."""

SET_POINT = 0.04
"""Time between two set-points on the way to a target [s]."""
SPEED = 1.0
"""Highest joint speed on the way [rad/s]."""
REST = 1.0
"""Rest at a target [s]; the last fifth of it is judged."""


class ActualArm:
    """An arm in a simulation without a bus."""

    def __init__(self, robot: RobotConfig, arm: int, rate: float = RATE) -> None:
        """Build arm number `arm`; samples come at `rate` [Hz] of its own time."""
        simulator: Any = simulator_of(robot)
        self.robot = robot
        self._world = simulator.world("actual", arm)
        self._body = direct_robot(robot, self._world)
        self._rate = rate

    def __enter__(self) -> Self:
        self._body.open()
        self._playground = DirectPlayground(self._body, self._rate)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._body.close()

    def play(self, command: np.ndarray, duration: float) -> Iterator[Values]:
        """Hold wire lengths [m], shape (10,), for a duration [s]; return samples [unit].

        Raises:
            CollectionStopped: The limits of the robot file stopped the arm.
        """
        return self._playground.play(command, duration)

    def break_part(self, part: str) -> None:
        """Break a part: `muscle_cut:biceps`, `heavy_object`."""
        self._world.break_part(part)

    def position(self) -> np.ndarray:
        """Return the true joint positions [rad], shape (5,)."""
        return np.asarray(self._world.truth()[POSITION])

    def elapsed(self) -> float:
        """Return the time since the arm was enabled [s]."""
        return self._playground.elapsed()


def recording_layout(robot: RobotConfig) -> Layout:
    """Return the layout of the robot's signals and the commands."""
    command = robot.signals[robot.command.signal]
    return Layout((*layout_of(robot).signals, Signal(SENT, command.size, command.unit, command.elements)))


def record(
    robot: RobotConfig,
    arm: int,
    seed: int,
    duration: float,
    parts: Sequence[tuple[float, str]] = (),
    rate: float = RATE,
) -> Dataset:
    """Record random motion of one arm.

    Args:
        robot: The robot file's content.
        arm: Which arm.
        seed: Of the motion.
        duration: How long [s of the arm's time].
        parts: (time [s], part that breaks then), the earliest first.
        rate: Rate of the samples [Hz].

    Returns:
        One episode; shorter than asked if a broken arm was stopped by its limits.
    """
    rows: list[dict[str, np.ndarray]] = []
    left = list(parts)
    with ActualArm(robot, arm, rate) as body:
        for command, hold in registry.load_object(robot.collect["motion"])(robot, seed):
            while left and body.elapsed() >= left[0][0]:
                body.break_part(left.pop(0)[1])
            if body.elapsed() >= duration:
                break
            try:
                rows.extend({**sample, SENT: command} for sample in body.play(command, hold))
            except CollectionStopped:
                if not parts or left:
                    raise
                break
    values = {name: np.array([row[name] for row in rows]) for name in recording_layout(robot).names}
    return Dataset(recording_layout(robot), (Episode(f"arm {arm}", values),))


def signals(recording: Dataset) -> dict[str, np.ndarray]:
    """Return signal -> samples [unit], shape (count, n), commands included."""
    return recording.layout.split(recording.rows())


def go(body: ActualArm, controller: Controller, start: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Move the arm from one reference posture to another along a smooth step, and let it rest there.

    Args:
        body: The arm.
        controller: Finds the wire lengths of every posture on the way.
        start: First reference [rad], shape (5,).
        target: Last reference [rad], shape (5,).

    Returns:
        Joint positions at the end of the rest, mean over a fifth of it [rad], shape (5,).

    Raises:
        CollectionStopped: The limits of the robot file stopped the arm.
    """
    duration = max(0.5, 1.9 * float(np.abs(target - start).max()) / SPEED)
    count = round(duration / SET_POINT)
    now: Values = {}
    for index in range(1, count + 1):
        share = (index / count) ** 3 * (10.0 - 15.0 * index / count + 6.0 * (index / count) ** 2)
        command = controller.solve({POSITION: start + share * (target - start)}, now).command
        for sample in body.play(command, SET_POINT):
            now = sample
    rest = [sample[POSITION] for sample in body.play(command, REST)]
    return np.asarray(np.mean(rest[-max(1, len(rest) // 5) :], axis=0))
