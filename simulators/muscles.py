"""Wires over via points: path lengths, moment arms, and the elastic element each wire ends in."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np

from simulators.chain import Chain, Pose, cross


@dataclass(frozen=True, slots=True)
class Via:
    """A point that a wire passes through, fixed in one frame of the chain (0: the base)."""

    frame: int
    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True)
class Sphere:
    """A joint's capsule: a wire whose straight line would cut through it bends around it."""

    frame: int
    center: tuple[float, float, float]
    radius: float


class Paths:
    """The routes of m wires over a chain of n joints.

    A route is its via points in order. Where two neighbours lie in different frames, the stretch between them changes
    with posture; it is a straight line, or bends around the first sphere that sits on a joint between the two frames.
    """

    def __init__(self, chain: Chain, routes: Mapping[str, Sequence[Via]], spheres: Sequence[Sphere] = ()) -> None:
        self.chain = chain
        self.names = tuple(routes)
        stretches = [
            (muscle, start, end) for muscle, route in enumerate(routes.values()) for start, end in pairwise(route)
        ]
        crossing = [part for part in stretches if part[1].frame != part[2].frame]
        self._fixed = np.zeros(len(routes))
        for muscle, start, end in stretches:
            if start.frame == end.frame:
                self._fixed[muscle] += np.linalg.norm(_local(end) - _local(start))
        bent = [_sphere_between(start, end, spheres) for _, start, end in crossing]
        self._bends = any(sphere is not None for sphere in bent)
        spheres_or_none = [sphere or Sphere(0, (0.0, 0.0, 0.0), 0.0) for sphere in bent]
        self._radius = np.array([sphere.radius for sphere in spheres_or_none])
        self._frames = np.array(
            [start.frame for _, start, _ in crossing]
            + [end.frame for _, _, end in crossing]
            + ([sphere.frame for sphere in spheres_or_none] if self._bends else [])
        )
        self._points = np.array(
            [_local(start) for _, start, _ in crossing]
            + [_local(end) for _, _, end in crossing]
            + ([sphere.center for sphere in spheres_or_none] if self._bends else [])
        )
        self._count = len(crossing)
        self._moves = chain.moves[self._frames].astype(float)
        self._belongs = np.zeros((len(routes), self._count))
        self._belongs[[muscle for muscle, _, _ in crossing], np.arange(self._count)] = 1.0
        self._ends = np.tile(self._belongs, 2 + self._bends)

    def solve(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Path lengths [m], shape (m,), and moment arms dL/dq [m/rad], shape (m, n), at joint positions [rad] (n,)."""
        pose = self.chain.pose(position)
        points = pose.points(self._frames, self._points)
        start, end = points[: self._count], points[self._count : 2 * self._count]
        along = end - start
        lengths = np.sqrt((along * along).sum(axis=1))
        along /= lengths[:, None]
        if self._bends:
            pulls = _bend(start, end, points[2 * self._count :], self._radius, lengths, along)
        else:
            pulls = np.concatenate([-along, along])
        return self._fixed + self._belongs @ lengths, self._arms(pose, points, pulls)

    def lengths(self, position: np.ndarray) -> np.ndarray:
        """Path lengths [m], shape (m,), at joint positions [rad], shape (n,)."""
        return self.solve(position)[0]

    def _arms(self, pose: Pose, points: np.ndarray, pulls: np.ndarray) -> np.ndarray:
        """dL/dq from dL/d(point): each point's pull is a wrench on the joints that move it."""
        wrenches = np.concatenate([pulls, cross(points, pulls)], axis=1)
        arms: np.ndarray = self._ends @ (self._moves * (wrenches @ pose.screws()))
        return arms


@dataclass(frozen=True, slots=True)
class Elastic:
    """A stiffening elastic element per wire: f = scale (exp(rate x) - 1), slack below x = 0, and its exact inverse.

    Attributes:
        scale: Tension scale [N], scalar or shape (m,).
        rate: Stiffening [1/m], scalar or shape (m,).
    """

    scale: np.ndarray
    rate: np.ndarray

    @classmethod
    def of(cls, size: int, scale: float, rate: float) -> Self:
        """The same element for `size` wires."""
        return cls(np.full(size, scale), np.full(size, rate))

    def tension(self, elongation: np.ndarray) -> np.ndarray:
        """Tension [N] at an elongation [m]; zero when slack."""
        tension: np.ndarray = self.scale * np.expm1(self.rate * np.maximum(elongation, 0.0))
        return tension

    def elongation(self, tension: np.ndarray) -> np.ndarray:
        """Elongation [m] at a tension [N]."""
        elongation: np.ndarray = np.log1p(tension / self.scale) / self.rate
        return elongation

    def stiffness(self, tension: np.ndarray) -> np.ndarray:
        """Slope df/dx [N/m] at a tension [N]."""
        slope: np.ndarray = self.rate * (tension + self.scale)
        return slope


def _local(via: Via) -> np.ndarray:
    return np.array([via.x, via.y, via.z])


def _sphere_between(start: Via, end: Via, spheres: Sequence[Sphere]) -> Sphere | None:
    low, high = sorted((start.frame, end.frame))
    return next((sphere for sphere in spheres if low < sphere.frame <= high), None)


def _bend(
    start: np.ndarray,
    end: np.ndarray,
    center: np.ndarray,
    radius: np.ndarray,
    lengths: np.ndarray,
    along: np.ndarray,
) -> np.ndarray:
    """Bend the stretches whose straight line cuts a sphere; lengths [m] are corrected in place.

    The shortest way around a sphere lies in the plane of its centre and both ends: tangent, arc, tangent.

    Returns:
        dL/d(start, end, centre), shape (3 p, 3). A sphere is pushed by what its wire's ends are not pulled with.
    """
    a, b = start - center, end - center
    from_a = np.maximum(np.sqrt((a * a).sum(axis=1)), 1.001 * radius)
    from_b = np.maximum(np.sqrt((b * b).sum(axis=1)), 1.001 * radius)
    cosine = np.minimum(np.maximum((a * b).sum(axis=1) / (from_a * from_b), -0.999999), 0.999999)
    arc = np.arccos(cosine) - np.arccos(radius / from_a) - np.arccos(radius / from_b)
    touches = (arc > 0.0) & (radius > 0.0)
    pull_a, pull_b = -along, along
    if touches.any():
        a, b = a / from_a[:, None], b / from_b[:, None]
        sine = np.sqrt(1.0 - cosine**2)[:, None]
        tangent_a, tangent_b = np.sqrt(from_a**2 - radius**2), np.sqrt(from_b**2 - radius**2)
        lengths[touches] = (tangent_a + tangent_b + radius * arc)[touches]
        toward_b, toward_a = (b - cosine[:, None] * a) / sine, (a - cosine[:, None] * b) / sine
        bent_a = (tangent_a[:, None] * a - radius[:, None] * toward_b) / from_a[:, None]
        bent_b = (tangent_b[:, None] * b - radius[:, None] * toward_a) / from_b[:, None]
        pull_a = np.where(touches[:, None], bent_a, pull_a)
        pull_b = np.where(touches[:, None], bent_b, pull_b)
    return np.concatenate([pull_a, pull_b, -(pull_a + pull_b)])
