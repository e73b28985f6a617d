"""A planar arm that fits on a page: two joints, five muscles of which one spans both, nonlinear springs.

l_i = L_i(theta) - s_i(f_i): the wire is shorter than its path by what the spring has given. Tensions that balance no
torque are allowed, as on data that a designer makes from a geometric model.
"""

from dataclasses import dataclass

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.signals import Layout, Signal

JOINTS = ("shoulder", "elbow")
MUSCLES = ("front", "back", "flexor", "extensor", "both")
LAYOUT = Layout(
    (
        Signal("joint_position", 2, "rad", JOINTS),
        Signal("muscle_tension", 5, "N", MUSCLES),
        Signal("muscle_length", 5, "m", MUSCLES),
    )
)
LOW, HIGH = np.array([-0.8, 0.2]), np.array([0.8, 1.6])  # [rad]
MOST = 100.0  # [N]
GIVE = 0.02  # spring travel at MOST [m]


@dataclass(frozen=True)
class MuscleArm:
    """Moment arms at the middle posture [m], how much the springs give, and how far the wires were moved [m]."""

    arms: tuple[tuple[float, float], ...] = ((0.04, 0.0), (-0.04, 0.0), (0.0, 0.03), (0.0, -0.03), (0.03, 0.025))
    bend: float = 0.01
    softness: float = 1.0
    offset: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def path(self, theta: np.ndarray) -> np.ndarray:
        """Path lengths [m], shape (n, 5), of joint positions [rad], shape (n, 2)."""
        return (
            0.3
            + np.array(self.offset)
            + theta @ np.array(self.arms).T
            + self.bend * np.sin(theta @ np.array(self.arms).T / 0.02)
        )

    def length(self, theta: np.ndarray, tension: np.ndarray) -> np.ndarray:
        """Wire lengths [m], shape (n, 5)."""
        return self.path(theta) - self.softness * GIVE * np.sqrt(tension / MOST)

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        """dl/dtheta [m/rad], shape (5, 2), at one posture, shape (2,)."""
        arms = np.array(self.arms)
        return arms * (1.0 + self.bend / 0.02 * np.cos(theta @ arms.T / 0.02))[:, None]

    def sample(self, count: int, seed: int) -> dict[str, np.ndarray]:
        """Independent random postures and tensions with the lengths that go with them."""
        random = np.random.default_rng(seed)
        theta = random.uniform(LOW, HIGH, (count, 2))
        tension = random.uniform(2.0, MOST, (count, 5))
        return {"joint_position": theta, "muscle_tension": tension, "muscle_length": self.length(theta, tension)}

    def episodes(self, count: int, size: int, seed: int = 0) -> Dataset:
        """Several episodes of random samples."""
        return Dataset(LAYOUT, tuple(Episode("new", self.sample(size, 1000 * seed + i)) for i in range(count)))


def gravity(theta: np.ndarray) -> np.ndarray:
    """Joint torque that holds two links of 0.5 kg and 0.3 m in a vertical plane [N m], shape (2,)."""
    both = theta[0] + theta[1]
    lower = 0.5 * 9.81 * 0.15 * np.sin(both)
    return np.array([0.5 * 9.81 * 0.45 * np.sin(theta[0]) + lower, lower])
