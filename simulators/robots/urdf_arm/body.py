"""An arm as it can be built: the `nominal` variant is the URDF, and `actual` ones are drawn around it from a seed."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from hal.config import RobotConfig
from hal.errors import ConfigError
from simulators.robots.urdf_arm.choice import Arm, arm_of
from simulators.robots.urdf_arm.tree import read_tree

VARIANTS = ("nominal", "actual")
MOTOR, JOINT, EFFORT, TIP = "motor_position", "joint_position", "joint_effort", "tool_tip_position"
"""These signals of an arm are motors [rad] before and joints [rad] behind the gears, torques [N m], and the tip [m]."""


@dataclass(frozen=True, slots=True)
class Body:
    """One variant of an arm with n joints.

    Attributes:
        zeros: Errors of the encoders' zeros [rad], shape (n,).
        weights: Factors of the masses behind every joint, shape (n,).
        camera_shift: Error of the camera's place, in parts of the reach, shape (3,).
        encoder_noise: Standard deviation of the encoders [rad].
        effort_noise: Standard deviation of the measured torques, in parts of the largest one.
        camera_noise: Standard deviation of the camera, in parts of the reach.
    """

    zeros: np.ndarray
    weights: np.ndarray
    camera_shift: np.ndarray
    encoder_noise: float = 0.0005
    effort_noise: float = 0.01
    camera_noise: float = 0.002


def make_body(variant: str, size: int, seed: int) -> Body:
    """Return one variant of an arm with `size` joints; the seed chooses among the actual ones.

    Raises:
        ConfigError: The variant is not known.
    """
    if variant not in VARIANTS:
        raise ConfigError(f"An arm of a URDF has no variant '{variant}'. Known variants: {', '.join(VARIANTS)}.")
    if variant == "nominal":
        return Body(np.zeros(size), np.ones(size), np.zeros(3))
    random = np.random.default_rng([seed, 7])
    return Body(
        zeros=random.normal(0.0, 0.001, size),
        weights=random.normal(1.0, 0.05, size),
        camera_shift=random.normal(0.0, 0.002, 3),
    )


def arm_in(config: RobotConfig) -> Arm:
    """Return the arm of a robot file.

    Raises:
        ConfigError: The robot file lacks the URDF, the tip or a signal, or does not fit the URDF.
    """
    for signal in (MOTOR, JOINT):
        if signal not in config.signals:
            raise ConfigError(f"Robot '{config.robot}' needs the signal {signal} for the simulator of a URDF.")
    if config.urdf is None or config.tip is None:
        raise ConfigError(
            f"Robot '{config.robot}' needs `urdf` and `tip` for its simulator. Make the file by `gemuco init`."
        )
    return _arm(config.folder / config.urdf, config.signals[MOTOR].elements, config.tip)


@cache
def _arm(path: Path, joints: tuple[str, ...], tip: str) -> Arm:
    return arm_of(read_tree(path), joints, tip)
