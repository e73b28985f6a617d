"""A planar arm that fits on a page and holds a tool: three joints, a tool of some length, angle and mass in its hand.

What tells of the tool is strong (where its tip is) or weak (where the center of gravity is).
"""

from dataclasses import dataclass

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.signals import Layout, Signal

LAYOUT = Layout(
    (
        Signal("joint_position", 3, "rad"),
        Signal("center_of_gravity", 1, "m"),
        Signal("tool_tip_position", 2, "m", ("x", "y")),
    )
)
MASKS = (
    ("joint_position",),
    ("joint_position", "center_of_gravity"),
    ("joint_position", "tool_tip_position"),
    ("joint_position", "center_of_gravity", "tool_tip_position"),
)
LINK = 0.3  # length of every link [m]
BODY = 3.0  # mass of the arm and what carries it [kg]


@dataclass(frozen=True)
class ToolArm:
    """Length of the tool [m], its angle to the last link [rad], its mass [kg]; noise [m], bend of the joints [rad]."""

    length: float
    angle: float = 0.0
    mass: float = 0.3
    noise: float = 0.002
    weak_noise: float = 0.004
    bend: float = 0.0

    def measure(self, theta: np.ndarray, seed: int) -> dict[str, np.ndarray]:
        """Signals at joint positions [rad], shape (n, 3)."""
        random = np.random.default_rng(seed)
        real = theta + self.bend * np.cos(np.cumsum(theta, axis=1))
        heading = np.cumsum(real, axis=1)
        hand = LINK * np.stack([np.cos(heading).sum(axis=1), np.sin(heading).sum(axis=1)], axis=1)
        along = heading[:, -1] + self.angle
        tip = hand + self.length * np.stack([np.cos(along), np.sin(along)], axis=1)
        weight = 0.5 * (hand[:, 0] + tip[:, 0]) * self.mass + 0.4 * hand[:, 0]
        gravity = weight[:, None] / (BODY + self.mass)
        return {
            "joint_position": theta,
            "center_of_gravity": gravity + self.weak_noise * random.standard_normal(gravity.shape),
            "tool_tip_position": tip + self.noise * random.standard_normal(tip.shape),
        }

    def sample(self, count: int, seed: int) -> dict[str, np.ndarray]:
        """Signals at independent random postures."""
        return self.measure(np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3)), seed)

    def walk(self, count: int, seed: int, step: float = 0.15) -> dict[str, np.ndarray]:
        """Signals at postures each near the one before it."""
        random = np.random.default_rng(seed)
        theta = np.zeros((count, 3))
        theta[0] = random.uniform(-1.0, 1.0, 3)
        for index in range(1, count):
            theta[index] = np.clip(theta[index - 1] + step * random.standard_normal(3), -1.0, 1.0)
        return self.measure(theta, seed)


def tools(lengths: tuple[float, ...], angles: tuple[float, ...], masses: tuple[float, ...]) -> dict[str, ToolArm]:
    """Condition -> arm, for every combination."""
    return {
        f"{length}/{angle}/{mass}": ToolArm(length, angle, mass)
        for length in lengths
        for angle in angles
        for mass in masses
    }


def dataset(arms: dict[str, ToolArm], count: int, episodes: int = 2) -> Dataset:
    """So many samples of every arm."""
    parts = [
        Episode(condition, arm.sample(count // episodes, 100 * index + part))
        for index, (condition, arm) in enumerate(arms.items())
        for part in range(episodes)
    ]
    return Dataset(LAYOUT, tuple(parts))
