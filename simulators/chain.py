"""A serial chain of revolute joints: where its links are, which way its joints move them, what gravity asks of it."""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Self

import numpy as np

GRAVITY = 9.81
"""Gravity acts along -z of the base with this acceleration [m/s^2]."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of every frame of a chain, in base coordinates.

    Frame 0 is the base, frame k the link behind joint k - 1.

    Attributes:
        rotations: Frame orientations, shape (n + 1, 3, 3).
        origins: Frame origins [m], shape (n + 1, 3).
        axes: Joint axes, shape (n, 3).
    """

    rotations: np.ndarray
    origins: np.ndarray
    axes: np.ndarray

    def screws(self) -> np.ndarray:
        """Return the joint screws, shape (6, n).

        A wrench (force [N], moment about the base origin [N m]) times column j is its torque about joint j [N m].
        """
        screws = np.empty((6, len(self.axes)))
        screws[:3] = cross(self.origins[1:], self.axes).T
        screws[3:] = self.axes.T
        return screws

    def points(self, frames: np.ndarray, local: np.ndarray) -> np.ndarray:
        """Return points fixed in frames (p,) with local coordinates [m] (p, 3) in base coordinates [m], shape (p,
        3).
        """
        turned: np.ndarray = np.matmul(self.rotations.take(frames, 0), local[:, :, None])[:, :, 0]
        turned += self.origins.take(frames, 0)
        return turned


@dataclass(frozen=True, slots=True)
class Chain:
    """Serial chain of n revolute joints, as a URDF describes it.

    Attributes:
        joints: Joint names, base first.
        axes: Joint axes in the joint's own frame, shape (n, 3).
        offsets: Joint origins in the frame before [m], shape (n, 3).
        masses: Link masses [kg], shape (n,).
        centers: Centres of mass in the link's frame [m], shape (n, 3).
        low: Lowest joint positions [rad], shape (n,).
        high: Highest joint positions [rad], shape (n,).
        moves: Whether joint j moves frame k, shape (n + 1, n).
    """

    joints: tuple[str, ...]
    axes: np.ndarray
    offsets: np.ndarray
    masses: np.ndarray
    centers: np.ndarray
    low: np.ndarray
    high: np.ndarray
    moves: np.ndarray
    _cross: np.ndarray
    _cross_squared: np.ndarray

    @classmethod
    def from_urdf(cls, path: Path) -> Self:
        """Read a URDF whose joints all turn, one behind the other, without turned origins.

        A continuous joint has infinite limits.

        Raises:
            ValueError: The URDF describes something else.
        """
        root = ElementTree.parse(path).getroot()
        joints = root.findall("joint")
        links = {link.get("name"): link for link in root.findall("link")}
        for before, joint in pairwise(joints):
            if _child(joint, "parent").get("link") != _child(before, "child").get("link"):
                raise ValueError(f"{path.name}: joint '{joint.get('name')}' does not follow '{before.get('name')}'.")
        for joint in joints:
            turns = joint.get("type") in ("revolute", "continuous")
            if not turns or _vector(_child(joint, "origin").get("rpy", "0 0 0")).any():
                raise ValueError(f"{path.name}: joint '{joint.get('name')}' is not revolute with a straight origin.")
        bodies = [_child(links[_child(joint, "child").get("link")], "inertial") for joint in joints]
        limits = [_child(joint, "limit") for joint in joints]
        axes = np.array([_vector(_child(joint, "axis").get("xyz")) for joint in joints])
        cross = np.array([np.cross(np.eye(3), axis) for axis in axes])
        return cls(
            joints=tuple(str(joint.get("name")) for joint in joints),
            axes=axes,
            offsets=np.array([_vector(_child(joint, "origin").get("xyz")) for joint in joints]),
            masses=np.array([float(_child(body, "mass").get("value", "nan")) for body in bodies]),
            centers=np.array([_vector(_child(body, "origin").get("xyz")) for body in bodies]),
            low=np.array([float(limit.get("lower", "-inf")) for limit in limits]),
            high=np.array([float(limit.get("upper", "inf")) for limit in limits]),
            moves=np.tri(len(joints) + 1, len(joints), -1, dtype=bool),
            _cross=cross,
            _cross_squared=cross @ cross,
        )

    def pose(self, position: np.ndarray) -> Pose:
        """Return the forward kinematics of joint positions [rad], shape (n,)."""
        size = len(self.joints)
        turns = np.sin(position)[:, None, None] * self._cross
        turns += (1.0 - np.cos(position))[:, None, None] * self._cross_squared
        turns += _UPRIGHT
        rotations = np.empty((size + 1, 3, 3))
        rotations[0] = _UPRIGHT
        for joint in range(size):
            np.matmul(rotations[joint], turns[joint], out=rotations[joint + 1])
        before = rotations[:-1]
        axes = np.matmul(before, self.axes[:, :, None])[:, :, 0]
        origins = np.zeros((size + 1, 3))
        np.cumsum(np.matmul(before, self.offsets[:, :, None])[:, :, 0], axis=0, out=origins[1:])
        return Pose(rotations, origins, axes)

    def frames(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return every frame at many joint positions [rad], shape (k, n); see `Pose` for their numbers.

        Returns:
            Orientations, shape (n + 1, k, 3, 3), and origins [m], shape (n + 1, k, 3), in base coordinates.
        """
        turns = np.sin(positions)[:, :, None, None] * self._cross
        turns += (1.0 - np.cos(positions))[:, :, None, None] * self._cross_squared
        turns += _UPRIGHT
        size = len(self.joints)
        rotations = np.empty((size + 1, len(positions), 3, 3))
        origins = np.zeros((size + 1, len(positions), 3))
        rotations[0] = _UPRIGHT
        for joint in range(size):
            np.matmul(rotations[joint], turns[:, joint], out=rotations[joint + 1])
        before = np.matmul(rotations[:-1], self.offsets[:, None, :, None])[..., 0]
        np.cumsum(before, axis=0, out=origins[1:])
        return rotations, origins

    def ends(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the last frame at many joint positions [rad], shape (k, n): orientations (k, 3, 3), origins [m] (k,
        3).
        """
        rotations, origins = self.frames(positions)
        return rotations[-1], origins[-1]

    def gravity_torque(self, position: np.ndarray) -> np.ndarray:
        """Return the joint torques [N m] that hold the links against gravity at joint positions [rad]; both of shape
        (n,).
        """
        pose = self.pose(position)
        moments = np.matmul(pose.rotations[1:], self.centers[:, :, None])[:, :, 0] + pose.origins[1:]
        moments *= self.masses[:, None]
        carried = moments[::-1].cumsum(axis=0)[::-1]  # (n, 3): first mass moments of all that a joint moves
        carried -= self.masses[::-1].cumsum()[::-1, None] * pose.origins[1:]
        torque: np.ndarray = GRAVITY * (pose.axes[:, 0] * carried[:, 1] - pose.axes[:, 1] * carried[:, 0])
        return torque


_UPRIGHT = np.eye(3)
_NEXT = np.array([1, 2, 0])
_LAST = np.array([2, 0, 1])


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the row-wise cross product, shapes (p, 3), in a third of the time of `np.cross` on a few rows."""
    product: np.ndarray = a.take(_NEXT, 1) * b.take(_LAST, 1)
    product -= a.take(_LAST, 1) * b.take(_NEXT, 1)
    return product


def _child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    child = element.find(tag)
    if child is None:
        raise ValueError(f"The URDF's {element.tag} '{element.get('name', '')}' has no <{tag}>.")
    return child


def _vector(text: str | None) -> np.ndarray:
    return np.array([float(part) for part in (text or "").split()])
