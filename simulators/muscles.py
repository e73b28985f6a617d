"""Wires over via points: path lengths, moment arms, and the elastic element each wire ends in."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np

from simulators.chain import Chain
from simulators.muscle_kernels import paths


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
        around = [sphere or Sphere(0, (0.0, 0.0, 0.0), 0.0) for sphere in bent]
        self._crossing = (
            np.array([muscle for muscle, _, _ in crossing], int),
            np.array(
                [(start.frame, end.frame, ball.frame) for (_, start, end), ball in zip(crossing, around, strict=True)]
            ),
            np.array(
                [
                    (_local(start), _local(end), ball.center)
                    for (_, start, end), ball in zip(crossing, around, strict=True)
                ]
            ),
            np.array([sphere.radius for sphere in around]),
        )

    def solve(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the path lengths [m], shape (m,), and moment arms dL/dq [m/rad], shape (m, n), at joint positions
        [rad] (n,).
        """
        lengths, arms = self._fixed.copy(), np.zeros((len(self._fixed), len(self.chain.joints)))
        paths(np.asarray(position, float), self.chain.axes, self.chain.offsets, *self._crossing, lengths, arms)
        return lengths, arms

    def lengths(self, position: np.ndarray) -> np.ndarray:
        """Return the path lengths [m], shape (m,), at joint positions [rad], shape (n,)."""
        return self.solve(position)[0]


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
        """Return the same element for `size` wires."""
        return cls(np.full(size, scale), np.full(size, rate))

    def tension(self, elongation: np.ndarray) -> np.ndarray:
        """Return the tension [N] at an elongation [m]; zero when slack."""
        tension: np.ndarray = self.scale * np.expm1(self.rate * np.maximum(elongation, 0.0))
        return tension

    def elongation(self, tension: np.ndarray) -> np.ndarray:
        """Return the elongation [m] at a tension [N]."""
        elongation: np.ndarray = np.log1p(tension / self.scale) / self.rate
        return elongation

    def stiffness(self, tension: np.ndarray) -> np.ndarray:
        """Return the slope df/dx [N/m] at a tension [N]."""
        slope: np.ndarray = self.rate * (tension + self.scale)
        return slope


def _local(via: Via) -> np.ndarray:
    return np.array([via.x, via.y, via.z])


def _sphere_between(start: Via, end: Via, spheres: Sequence[Sphere]) -> Sphere | None:
    low, high = sorted((start.frame, end.frame))
    return next((sphere for sphere in spheres if low < sphere.frame <= high), None)
