"""The PR2's arm in its experiments, and its designer's geometry."""

import numpy as np

from hal import registry
from hal.config import RobotConfig
from services.model.model_config import collect_config
from studies.paper.body import JOINTS, Body

TIP = "tool_tip_position"
ARRIVED = 1e-4
"""Joint travel per step [rad] below which the arm stands."""
STROKE = np.array([0.2, 0.0, -0.2])
ADVANCE = np.array([0.0, 0.1, 0.0])
"""Vectors of the paper's duster motion [m]: forth, and sideways on the way back."""
STROKES, POINTS = 4, 5
"""Number of strokes of a motion, and of points on the way forth and on the way back."""
START = np.array([0.76, -0.1, 1.2])
"""First point of the motion [m]; in reach with every duster."""
ITERATIONS, CENTRING = 60, 0.5
"""Iterations of the inverse kinematics, and weight of the middle of the joint ranges."""
SHORT, LONG = "l300_phi30", "l700_phi30"
"""Two grasps of one stick, whose tips show its direction."""


class Arm(Body):
    """The simulated arm."""

    def __init__(self, robot: RobotConfig, variant: str, seed: int, condition: str) -> None:
        super().__init__(robot, variant, seed, condition, ARRIVED)

    def tip(self) -> np.ndarray:
        """Return the true tool tip [m], shape (3,)."""
        return self.truth(TIP)


class Geometry:
    """The designer's model of the arm: the robot file's `collect.forecast`."""

    def __init__(self, robot: RobotConfig) -> None:
        self._robot = robot
        self._forecast = registry.load_object(str(collect_config(robot).forecast))
        self.low, self.high = robot.bounds(JOINTS)

    def tips(self, condition: str, postures: np.ndarray) -> np.ndarray:
        """Return tool tips [m], shape (k, 3), at joint positions [rad], shape (k, 7)."""
        tips: np.ndarray = self._forecast(self._robot, condition, postures)[TIP]
        return tips

    def elevations(self, postures: np.ndarray) -> np.ndarray:
        """Return the sine of the elevation of a stick held at 30 degrees, shape (k, 1)."""
        away = self.tips(LONG, postures) - self.tips(SHORT, postures)
        return away[:, 2:] / np.linalg.norm(away, axis=1, keepdims=True)

    def follow(self, targets: np.ndarray, condition: str, elevation: float) -> np.ndarray:
        """Return joint positions theta_orig [rad], shape (k, 7), that bring the tip to targets [m].

        Args:
            targets: Shape (k, 3).
            condition: The grasp that is believed.
            elevation: Constraint of the tool's rotation: the stick's elevation [rad].
        """
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        nudges = 1e-5 * np.concatenate([np.zeros((1, len(half))), np.eye(len(half))])
        share, postures = np.zeros(len(half)), []  # of the half width, from the middle
        for target in targets:
            goal = np.append(target, np.sin(elevation))
            for _ in range(ITERATIONS):
                at = middle + half * (share + nudges)
                reached = np.concatenate([self.tips(condition, at), self.elevations(at)], axis=1)
                slopes = (reached[1:] - reached[0]).T / 1e-5
                inverse = slopes.T @ np.linalg.inv(slopes @ slopes.T + 1e-7 * np.eye(4))
                step = inverse @ (goal - reached[0] + slopes @ share * CENTRING) - CENTRING * share
                share = share + np.clip(step, -0.3, 0.3)
                if np.abs(step).max() < 1e-5:
                    break
            postures.append(middle + half * share)
        return np.stack(postures)


def duster_motion(start: np.ndarray = START) -> np.ndarray:
    """Return targets of the tool tip [m], shape (n, 3): (200, -200) mm in x and z, and back with 100 mm in y."""
    shares = np.arange(POINTS)[:, None] / POINTS
    parts = []
    for stroke in range(STROKES):
        begin = start + stroke * ADVANCE
        parts += [begin + shares * STROKE, begin + STROKE + shares * (ADVANCE - STROKE)]
    return np.concatenate([*parts, (start + STROKES * ADVANCE)[None]])
