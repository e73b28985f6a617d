"""A simulated robot that moves from posture to posture."""

from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from hal import registry
from hal.config import RobotConfig
from services.model.living_model import layout_of

JOINTS = "joint_position"
TICK = 0.02
"""Step of the simulation [s]."""


class Body:
    """A simulated robot with a tool; not thread-safe.

    Args:
        robot: The robot file's content.
        variant: Variant of its simulator.
        seed: Seed of its noise.
        condition: The tool in its hand.
        arrived: Joint travel per step [rad] below which it stands.
    """

    def __init__(self, robot: RobotConfig, variant: str, seed: int, condition: str, arrived: float) -> None:
        self._world: Any = registry.load_object(str(robot.simulator), "simulator", ("world",)).world(
            variant, seed, condition
        )
        self._low, self._high = robot.bounds(JOINTS)
        self._elements = [f"{JOINTS}.{name}" for name in robot.signals[JOINTS].elements]
        self._signals, self._arrived = layout_of(robot).names, arrived

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._world.close()

    def go(self, posture: np.ndarray) -> Mapping[str, np.ndarray]:
        """Move to joint positions [rad], shape (n,), within the robot file's limits; return the signals at rest."""
        for element, angle in zip(self._elements, np.clip(posture, self._low, self._high).tolist(), strict=True):
            self._world.drive(element, angle, True)
        before = np.full(len(posture), np.inf)
        while np.abs((now := self._world.truth()[JOINTS]) - before).max() > self._arrived:
            before = now
            self._world.step(TICK)
        measured: Mapping[str, np.ndarray] = self._world.measure()
        return {name: measured[name] for name in self._signals}

    def truth(self, signal: str) -> np.ndarray:
        """Return a signal without noise [its unit], whether the camera sees it or not."""
        value: np.ndarray = self._world.truth()[signal]
        return value

    def hold(self, condition: str) -> None:
        """Put another tool into the hand."""
        self._world.break_part(f"tool_changed:{condition}")
