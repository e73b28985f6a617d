"""The PR2's arm in its experiments: moved posture by posture, and what its designer's geometry says of it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hal import registry
from hal.config import RobotConfig
from services.model.model_config import collect_config

JOINTS, TIP = "joint_position", "tool_tip_position"
TICK = 0.02
"""Step of the simulated arm [s]."""
ARRIVED = 1e-4
"""Joint travel per step [rad] below which the arm stands."""
STROKE = np.array([0.2, 0.0, -0.2])
ADVANCE = np.array([0.0, 0.1, 0.0])
"""The paper's duster motion [m]: forth, and back while advancing."""
STROKES, POINTS = 4, 5
"""Strokes of a motion, and points on the way forth and on the way back."""
START = np.array([0.76, -0.1, 1.2])
"""Where the motion begins [m]; in reach with every duster."""
ITERATIONS, CENTRING = 60, 0.5
"""Of the inverse kinematics, and how strongly joints are drawn to the middle of their ranges where they are free."""
SHORT, LONG = "l300_phi30", "l700_phi30"
"""Two tips of the same stick tell where it points."""


class Arm:
    """The simulated arm; not thread-safe."""

    def __init__(self, robot: RobotConfig, variant: str, seed: int, condition: str) -> None:
        simulator = registry.load(str(robot.simulator))
        self._world: Any = simulator.world(variant, seed, condition)
        self._low, self._high = robot.bounds(JOINTS)
        self._elements = [f"{JOINTS}.{name}" for name in robot.signals[JOINTS].elements]

    def __enter__(self) -> "Arm":
        return self

    def __exit__(self, *_: object) -> None:
        self._world.close()

    def go(self, posture: np.ndarray) -> Mapping[str, np.ndarray]:
        """Move to joint positions [rad], shape (7,), within the robot file's limits; what is measured there."""
        for element, angle in zip(self._elements, np.clip(posture, self._low, self._high).tolist(), strict=True):
            self._world.drive(element, angle, True)
        before = np.full(len(posture), np.inf)
        while np.abs((now := self._world.truth()[JOINTS]) - before).max() > ARRIVED:
            before = now
            self._world.step(TICK)
        found: Mapping[str, np.ndarray] = self._world.measure()
        return found

    def tip(self) -> np.ndarray:
        """Where the tool tip is [m], whether the camera sees it or not, shape (3,)."""
        found: np.ndarray = self._world.truth()[TIP]
        return found

    def hold(self, condition: str) -> None:
        """Put another duster into the hand."""
        self._world.break_part(f"tool_changed:{condition}")


class Geometry:
    """The designer's model of the arm, the robot file's `collect.forecast`."""

    def __init__(self, robot: RobotConfig) -> None:
        self._robot = robot
        self._forecast = registry.load(str(collect_config(robot).forecast))
        self.low, self.high = robot.bounds(JOINTS)

    def tips(self, condition: str, postures: np.ndarray) -> np.ndarray:
        """Tool tips [m], shape (k, 3), at joint positions [rad], shape (k, 7)."""
        found: np.ndarray = self._forecast(self._robot, condition, postures)[TIP]
        return found

    def elevations(self, postures: np.ndarray) -> np.ndarray:
        """Sine of the elevation of a stick held at 30 degrees, shape (k, 1)."""
        away = self.tips(LONG, postures) - self.tips(SHORT, postures)
        return away[:, 2:] / np.linalg.norm(away, axis=1, keepdims=True)

    def follow(self, targets: np.ndarray, condition: str, elevation: float) -> np.ndarray:
        """Inverse kinematics (theta_orig): joint positions [rad], shape (k, 7), that bring the tip to targets [m].

        Args:
            targets: Shape (k, 3).
            condition: The grasp that is believed.
            elevation: Constraint of the tool's rotation: the stick's elevation [rad].
        """
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        nudges = 1e-5 * np.concatenate([np.zeros((1, len(half))), np.eye(len(half))])
        share, found = np.zeros(len(half)), []  # of the half width, from the middle
        for target in targets:
            wanted = np.append(target, np.sin(elevation))
            for _ in range(ITERATIONS):
                at = middle + half * (share + nudges)
                reached = np.concatenate([self.tips(condition, at), self.elevations(at)], axis=1)
                slopes = (reached[1:] - reached[0]).T / 1e-5
                inverse = slopes.T @ np.linalg.inv(slopes @ slopes.T + 1e-7 * np.eye(4))
                step = inverse @ (wanted - reached[0] + slopes @ share * CENTRING) - CENTRING * share
                share = share + np.clip(step, -0.3, 0.3)
                if np.abs(step).max() < 1e-5:
                    break
            found.append(middle + half * share)
        return np.stack(found)


def duster_motion(start: np.ndarray = START) -> np.ndarray:
    """Targets of the tool tip [m], shape (n, 3): (200, -200) mm in x and z, and back with 100 mm in y."""
    shares = np.arange(POINTS)[:, None] / POINTS
    parts = []
    for stroke in range(STROKES):
        begin = start + stroke * ADVANCE
        parts += [begin + shares * STROKE, begin + STROKE + shares * (ADVANCE - STROKE)]
    return np.concatenate([*parts, (start + STROKES * ADVANCE)[None]])
