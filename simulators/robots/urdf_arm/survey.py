"""Where an arm can move without touching anything, how fast, and which torques it needs there."""

from dataclasses import dataclass

import numpy as np

from hal.errors import ConfigError
from simulators.physics.choice import ServoArm, make_arm
from simulators.robots.urdf_arm.body_file import physics_urdf
from simulators.robots.urdf_arm.choice import Arm
from simulators.robots.urdf_arm.tree import Joint

HALF, ALL = 0.6, 3.6
"""A joint moves at most this far to either side of the middle posture [rad], and all joints together by the second
number, so that few samples suffice: the more joints, the more postures there are."""
FASTEST = 1.5
"""A joint moves at most this fast [rad/s]."""
ACCELERATION = 8.0
"""A joint accelerates at most this much [rad/s2]."""
CANDIDATES = 60
"""At most this many middle postures are tried."""
POSTURES = 60
"""A middle posture is judged by this many random postures around it."""
FREE, LEAST = 0.9, 0.3
"""A middle posture is taken if this share of the postures touches nothing, or the best one if the second share does."""
MARGIN = 1.5
"""A motor has this multiple of the largest torque that is needed."""
SMALLEST = 0.02
"""A motor has at least this torque [N m]."""
STRONGEST = 50.0
"""A motor has at most this multiple of the torque that its joint needs: URDFs state 100 N m for a finger."""


@dataclass(frozen=True, slots=True)
class Survey:
    """Range, rate and torque of every joint; all of shape (n,).

    Attributes:
        low: Lowest position [rad].
        high: Highest position [rad].
        rate: Largest velocity [rad/s].
        effort: Torque that the motor has [N m].
        notes: Sentences on what was narrowed or guessed.
    """

    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray
    effort: np.ndarray
    notes: tuple[str, ...]

    @property
    def middle(self) -> np.ndarray:
        """Middle posture [rad], shape (n,)."""
        return 0.5 * (self.low + self.high)


def neutral(arm: Arm) -> np.ndarray:
    """Return the posture with all joints at 0 as far as their limits allow [rad], shape (n,)."""
    return np.array([joint.rest for joint in arm.joints])


def survey(arm: Arm) -> Survey:
    """Find a range in which the arm is free, and the torques that it needs there.

    Raises:
        ConfigError: The arm touches itself or the floor almost everywhere.
    """
    text, notes = physics_urdf(arm)
    body = make_arm(text, arm.names, neutral(arm), np.ones(len(arm.joints)))
    try:
        low, high, share = _free_range(arm, body)
        if share < LEAST:
            raise ConfigError(
                f"'{arm.tree.path}': the arm touches itself or the floor in {1 - share:.0%} of its postures wherever "
                "it is. Are its <collision> shapes right? Remove those that overlap, or name another link by --tip."
            )
        needed = needs(body, low, high)
    finally:
        body.close()
    stated = np.array([joint.effort for joint in arm.joints])
    weak = [name for name, own, need in zip(arm.names, stated, needed, strict=True) if own < need]
    if weak:
        notes.append(
            f"Torque of {', '.join(weak)} is from the inertia; the file states none, or less than gravity needs."
        )
    most = STRONGEST * needed
    strong = [name for name, own, limit in zip(arm.names, stated, most, strict=True) if own > limit]
    if strong:
        notes.append(
            f"Torque of {', '.join(strong)} is {STRONGEST:g} times what gravity and motion need; the file states more. "
            "A drive reports thousandths of its rated torque, and one of that size would not feel its load. If yours "
            "is that large, change its rated_torque."
        )
    velocity = np.array([joint.velocity or FASTEST for joint in arm.joints])
    narrow = [
        name for name, joint, a, b in zip(arm.names, arm.joints, low, high, strict=True) if _is_narrower(joint, a, b)
    ]
    if narrow:
        notes.append(
            f"The range of {', '.join(narrow)} is narrower than in the URDF: a model knows what it has seen, and a "
            "wider range needs more samples."
        )
    return Survey(low, high, np.minimum(velocity, FASTEST), motor_torques(arm, needed), tuple(notes))


def motor_torques(arm: Arm, needed: np.ndarray) -> np.ndarray:
    """Return the torque of every motor [N m], shape (n,): that of the URDF, at least the needed and not far beyond it.

    Args:
        arm: The arm.
        needed: Torques that the joints need [N m], shape (n,).
    """
    return np.clip([joint.effort for joint in arm.joints], needed, STRONGEST * needed)


def _is_narrower(joint: Joint, low: float, high: float) -> bool:
    return high - low < joint.high - joint.low - 1e-6


def _free_range(arm: Arm, body: ServoArm) -> tuple[np.ndarray, np.ndarray, float]:
    """Return lowest and highest positions [rad], shapes (n,), and the share of postures there that touch nothing."""
    random = np.random.default_rng(0)
    lowest, highest = (np.array([getattr(joint, end) for joint in arm.joints]) for end in ("low", "high"))
    half = np.minimum(min(HALF, ALL / len(arm.joints)), 0.5 * (highest - lowest))
    middle, best = np.clip(neutral(arm), lowest + half, highest - half), (0.0, np.zeros(0))
    for _ in range(CANDIDATES):
        postures = random.uniform(middle - half, middle + half, (POSTURES, half.size))
        share = 1.0 - float(np.mean([body.touches(posture) for posture in (middle, *postures)]))
        if share > best[0]:
            best = (share, middle)
        if share >= FREE:
            break
        ends = (np.clip(end, -np.pi, np.pi) for end in (lowest + half, np.maximum(highest - half, lowest + half)))
        middle = random.uniform(*ends)
    share, middle = best if best[0] else (0.0, middle)
    return middle - half, middle + half, float(share)


def needs(body: ServoArm, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the torque that every motor needs between two postures [N m], shape (n,), for gravity and acceleration."""
    random = np.random.default_rng(1)
    largest = np.full(low.size, SMALLEST)
    for posture in random.uniform(low, high, (POSTURES, low.size)):
        torque, inertia = body.torques(posture)
        largest = np.maximum(largest, MARGIN * (np.abs(torque) + ACCELERATION * inertia))
    return largest
