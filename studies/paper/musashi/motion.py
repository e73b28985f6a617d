"""One arm that was built otherwise than designed: moved at random or to targets, recorded, and broken on the way."""

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

POSITION, TENSION, LENGTH = "joint_position", "muscle_tension", "muscle_length"
SENT = "sent_length"
"""Beside the robot's signals a recording holds the wire lengths that were commanded [m]."""
RATE = 10.0
"""Samples per second of what is recorded, and of what is learned from."""

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
        self._body = simulator.without_bus(robot, self._world)
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
        """Hold wire lengths [m], shape (10,), for so long [s]; yields samples [unit].

        Raises:
            CollectionStopped: The limits of the robot file stopped the arm.
        """
        return self._playground.play(command, duration)

    def break_part(self, part: str) -> None:
        """`muscle_cut:biceps`, `heavy_object`."""
        self._world.break_part(part)

    def position(self) -> np.ndarray:
        """Joint positions that are [rad], shape (5,)."""
        return np.asarray(self._world.truth()[POSITION])

    def elapsed(self) -> float:
        """Time since it was enabled [s]."""
        return self._playground.elapsed()


def recording_layout(robot: RobotConfig) -> Layout:
    """The robot's signals and what was sent."""
    command = robot.signals[robot.command.signal]
    return Layout((*layout_of(robot).signals, Signal(SENT, command.size, command.unit, command.elements)))


def record(
    robot: RobotConfig, arm: int, seed: int, duration: float, parts: Sequence[tuple[float, str]] = ()
) -> Dataset:
    """Random motion of one arm.

    Args:
        robot: The robot file's content.
        arm: Which arm.
        seed: Of the motion.
        duration: How long [s of the arm's time].
        parts: (time [s], part that breaks then), the earliest first.

    Returns:
        One episode; shorter than asked if a broken arm was stopped by its limits.
    """
    rows: list[dict[str, np.ndarray]] = []
    left = list(parts)
    with ActualArm(robot, arm) as body:
        for command, hold in registry.load(robot.collect["motion"])(robot, seed):
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
    """Signal -> samples [unit], shape (count, n), with what was sent among them."""
    return recording.layout.split(recording.rows())


def go(body: ActualArm, controller: Controller, start: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Lead the arm from one reference posture to another along a smooth step, and let it rest there.

    Args:
        body: The arm.
        controller: Tells the wire lengths of every posture on the way.
        start: Where the reference is [rad], shape (5,).
        target: Where it shall go [rad], shape (5,).

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
