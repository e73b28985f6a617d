"""Place of the tip of an arm, from its joint positions."""

import numpy as np

from simulators.robots.urdf_arm.choice import Arm
from simulators.robots.urdf_arm.tree import cross_matrix, turned


class TipKinematics:
    """Forward kinematics of an arm's tip, prepared once: what is fixed between two joints is one transform."""

    def __init__(self, arm: Arm) -> None:
        """Prepare the chain from the root to the tip; joints that are not in the arm are held."""
        index = {joint.name: number for number, joint in enumerate(arm.joints)}
        self._columns: list[int] = []
        """Position of every turning joint among those of the arm, root first."""
        self._shifts: list[np.ndarray] = []
        """Place of every turning joint in the frame of the one before it [m]."""
        parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        turn, place = np.eye(3), np.zeros(3)
        for joint in arm.tree.way(arm.tip):
            place = place + turn @ joint.shift
            turn = turn @ joint.turn
            if joint.kind == "prismatic":
                place = place + turn @ (joint.axis * joint.rest)
            elif joint.kind in ("revolute", "continuous"):
                if joint.name in index:
                    cross = cross_matrix(joint.axis)
                    parts.append((turn, turn @ cross, turn @ cross @ cross))
                    self._columns.append(index[joint.name])
                    self._shifts.append(place)
                    turn, place = np.eye(3), np.zeros(3)
                else:
                    turn = turn @ turned(joint.axis, joint.rest)
        self._end: np.ndarray = place + turn @ arm.offset
        self._fixed, self._sine, self._cosine = (np.array(part) for part in zip(*parts, strict=True))

    def tips(self, positions: np.ndarray) -> np.ndarray:
        """Return places of the tip in the root's frame [m], shape (k, 3), at joint positions [rad], shape (k, n)."""
        angles = positions[:, self._columns, None, None]
        turns = self._fixed + np.sin(angles) * self._sine + (1.0 - np.cos(angles)) * self._cosine
        tips = np.broadcast_to(self._end, (len(positions), 3))
        for joint in reversed(range(len(self._columns))):
            tips = self._shifts[joint] + np.matmul(turns[:, joint], tips[:, :, None])[:, :, 0]
        return tips
