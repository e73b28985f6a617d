"""Forces on the load cells under the feet: a stiff body on eight equal springs that push and never pull."""

import numpy as np

from simulators.robots.kxr_humanoid.body import CELLS


def foot_forces(center: np.ndarray, weight: float) -> np.ndarray:
    """Return the force on every load cell [N], shape (8,), under a weight [N] at a centre of gravity [m], shape (2,).

    Cells that would have to pull are off the ground. With the centre of gravity beyond the feet the robot would
    fall; a person's hand holds it, and the forces are those of the nearest point that the feet can balance.
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
    """Return the centre of pressure [m] of forces on the cells [N], shape (8,), shape (2,); NaN without any."""
    total = forces.sum()
    pushed: np.ndarray = forces @ CELLS / total if total > 0.0 else np.full(2, np.nan)
    return pushed


def _balanced(center: np.ndarray, weight: float) -> np.ndarray | None:
    """Return spring forces with this sum and this centre, shape (8,); None if cells that only push cannot have it."""
    touching = np.ones(len(CELLS), bool)
    load = weight * np.array([1.0, *center])
    for _ in range(len(CELLS)):
        plane = np.column_stack([np.ones(touching.sum()), CELLS[touching]])
        forces = np.zeros(len(CELLS))
        forces[touching] = plane @ np.linalg.pinv(plane.T @ plane) @ load
        if np.abs(plane.T @ forces[touching] - load).max() > _SLACK * weight:
            return None
        pulling = forces < -_SLACK
        if not pulling.any():
            return np.maximum(forces, 0.0)
        touching &= ~pulling
    return None


_STANDING = np.linalg.pinv(np.column_stack([np.ones(len(CELLS)), CELLS]).T)
"""This matrix gives the forces of their sum and moments when every cell touches the ground, shape (8, 3)."""
_BACK = 0.97
"""Each try moves the point by this share towards the middle of the feet."""
_TRIES = 200
_SLACK = 1e-9
