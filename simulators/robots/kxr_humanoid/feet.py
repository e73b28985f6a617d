"""What the load cells under the feet carry: a stiff body on eight equal springs that push and never pull."""

import numpy as np

from simulators.robots.kxr_humanoid.body import CELLS


def foot_forces(center: np.ndarray, weight: float) -> np.ndarray:
    """Force on every load cell [N], shape (8,), under a weight [N] at a centre of gravity [m], shape (2,).

    Cells that would have to pull are off the ground. Where the centre of gravity is beyond the feet the robot would
    fall; a person's hand keeps it, and the forces are those of the nearest point that the feet can balance.
    """
    spread: np.ndarray = weight * (_STANDING @ (1.0, *center))
    if spread.min() >= 0.0:
        return spread
    for _ in range(_TRIES):
        forces = _balanced(center, weight)
        if forces is not None:
            return forces
        center = center * _BACK
    raise ValueError(f"The feet cannot carry {weight:g} N at {center}.")


def center_of(forces: np.ndarray) -> np.ndarray:
    """Where forces on the cells [N], shape (8,), push together [m], shape (2,); NaN without any."""
    total = forces.sum()
    pushed: np.ndarray = forces @ CELLS / total if total > 0.0 else np.full(2, np.nan)
    return pushed


def _balanced(center: np.ndarray, weight: float) -> np.ndarray | None:
    """Spring forces with this sum and this centre, shape (8,); None if cells that only push cannot have it."""
    touching = np.ones(len(CELLS), bool)
    wanted = weight * np.array([1.0, *center])
    for _ in range(len(CELLS)):
        plane = np.column_stack([np.ones(touching.sum()), CELLS[touching]])
        forces = np.zeros(len(CELLS))
        forces[touching] = plane @ np.linalg.pinv(plane.T @ plane) @ wanted
        if np.abs(plane.T @ forces[touching] - wanted).max() > _SLACK * weight:
            return None
        pulling = forces < -_SLACK
        if not pulling.any():
            return np.maximum(forces, 0.0)
        touching &= ~pulling
    return None


_STANDING = np.linalg.pinv(np.column_stack([np.ones(len(CELLS)), CELLS]).T)
"""Sum and moments of the forces -> forces when every cell touches the ground, shape (8, 3)."""
_BACK = 0.97
"""Towards the middle of the feet, per try."""
_TRIES = 200
_SLACK = 1e-9
