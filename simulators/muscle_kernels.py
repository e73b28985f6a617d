"""Computations of a muscle-driven body in every physics step, as compiled loops over a few numbers.

The arrays are so small that numpy spends its time on calls, not on arithmetic: the loops take a tenth of it, and hold
no interpreter lock, so that nodes answer meanwhile. numba keeps what it compiled beside this file.
"""

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np


def _compiled(function: Callable[..., Any]) -> Any:
    try:
        return numba.njit(cache=True, nogil=True)(function)
    except RuntimeError:  # nowhere to keep it, as in an image that nothing can be written to: compiled at every start
        return numba.njit(nogil=True)(function)


@_compiled
def _frames(
    position: np.ndarray, joint_axes: np.ndarray, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return forward kinematics as in `Chain.pose`: rotations (n + 1, 3, 3), origins [m] (n + 1, 3), joint axes (n,
    3).
    """
    size = len(position)
    rotations = np.zeros((size + 1, 3, 3))
    origins = np.zeros((size + 1, 3))
    axes = np.zeros((size, 3))
    for row in range(3):
        rotations[0, row, row] = 1.0
    turn = np.empty((3, 3))
    for joint in range(size):
        x, y, z = joint_axes[joint]
        sine, rest = math.sin(position[joint]), 1.0 - math.cos(position[joint])
        turn[0, 0], turn[1, 1], turn[2, 2] = (
            1 - rest * (y * y + z * z),
            1 - rest * (x * x + z * z),
            1 - rest * (x * x + y * y),
        )
        turn[0, 1], turn[1, 0] = rest * x * y - sine * z, rest * x * y + sine * z
        turn[0, 2], turn[2, 0] = rest * x * z + sine * y, rest * x * z - sine * y
        turn[1, 2], turn[2, 1] = rest * y * z - sine * x, rest * y * z + sine * x
        before = rotations[joint]
        for row in range(3):
            origins[joint + 1, row] = origins[joint, row]
            for inner in range(3):
                origins[joint + 1, row] += before[row, inner] * offsets[joint, inner]
                axes[joint, row] += before[row, inner] * joint_axes[joint, inner]
                for column in range(3):
                    rotations[joint + 1, row, column] += before[row, inner] * turn[inner, column]
    return rotations, origins, axes


@_compiled
def _place(rotation: np.ndarray, origin: np.ndarray, local: np.ndarray, into: np.ndarray) -> None:
    """Return a point of a frame [m] in base coordinates."""
    for row in range(3):
        into[row] = origin[row]
        for inner in range(3):
            into[row] += rotation[row, inner] * local[inner]


@_compiled
def _bend(
    start: np.ndarray, end: np.ndarray, center: np.ndarray, radius: float, pulls: np.ndarray, length: float
) -> float:
    """Return the length [m] of a stretch of wire around a sphere: tangent, arc, tangent; straight if it touches none.

    The shortest path lies in the plane of the centre and both ends. `pulls`, dL/d(start, end, centre), shape (3, 3), is
    corrected in place; the sphere takes the rest of the forces on the wire's ends.
    """
    from_a = from_b = along = 0.0
    for row in range(3):
        from_a += (start[row] - center[row]) ** 2
        from_b += (end[row] - center[row]) ** 2
        along += (start[row] - center[row]) * (end[row] - center[row])
    from_a, from_b = max(math.sqrt(from_a), 1.001 * radius), max(math.sqrt(from_b), 1.001 * radius)
    cosine = min(max(along / (from_a * from_b), -0.999999), 0.999999)
    arc = math.acos(cosine) - math.acos(radius / from_a) - math.acos(radius / from_b)
    if arc <= 0.0:
        return length
    sine = math.sqrt(1.0 - cosine * cosine)
    tangent_a, tangent_b = math.sqrt(from_a**2 - radius**2), math.sqrt(from_b**2 - radius**2)
    for row in range(3):
        a, b = (start[row] - center[row]) / from_a, (end[row] - center[row]) / from_b
        pulls[0, row] = (tangent_a * a - radius * (b - cosine * a) / sine) / from_a
        pulls[1, row] = (tangent_b * b - radius * (a - cosine * b) / sine) / from_b
        pulls[2, row] = -(pulls[0, row] + pulls[1, row])
    return tangent_a + tangent_b + radius * arc


@_compiled
def paths(
    position: np.ndarray, joint_axes: np.ndarray, offsets: np.ndarray, muscles: np.ndarray, frames: np.ndarray,
    points: np.ndarray, radius: np.ndarray, lengths: np.ndarray, arms: np.ndarray,
) -> None:  # fmt: skip
    """Add the p stretches between different frames to path lengths [m] (m,) and moment arms [m/rad] (m, n).

    Args:
        position: Joint positions [rad], shape (n,).
        joint_axes: In the joints' own frames, shape (n, 3).
        offsets: Joint origins in the frame before [m], shape (n, 3).
        muscles: Which wire a stretch belongs to, shape (p,).
        frames: Those of start, end and sphere of every stretch, shape (p, 3).
        points: Start, end and centre of the sphere in these frames [m], shape (p, 3, 3).
        radius: Of the spheres [m], shape (p,); 0 where there is none.
        lengths: Increased in place.
        arms: Likewise.
    """
    rotations, origins, axes = _frames(position, joint_axes, offsets)
    placed, pulls = np.empty((3, 3)), np.empty((3, 3))
    for stretch in range(len(muscles)):
        count = 3 if radius[stretch] > 0.0 else 2
        for part in range(count):
            frame = frames[stretch, part]
            _place(rotations[frame], origins[frame], points[stretch, part], placed[part])
        way = placed[1] - placed[0]
        length = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
        for row in range(3):
            pulls[0, row], pulls[1, row], pulls[2, row] = -way[row] / length, way[row] / length, 0.0
        if count == 3:
            length = _bend(placed[0], placed[1], placed[2], radius[stretch], pulls, length)
        muscle = muscles[stretch]
        lengths[muscle] += length
        for part in range(count):
            pull = pulls[part]
            for joint in range(frames[stretch, part]):  # the joints that move this frame
                x, y, z = placed[part] - origins[joint + 1]
                arms[muscle, joint] += (
                    axes[joint, 0] * (y * pull[2] - z * pull[1])
                    + axes[joint, 1] * (z * pull[0] - x * pull[2])
                    + axes[joint, 2] * (x * pull[1] - y * pull[0])
                )


@_compiled
def held(arms: np.ndarray, weight: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    """Return the matrix arms^T diag(weight) arms + diag(diagonal), shape (n, n), from shapes (m, n), (m,) and (n,)."""
    size = arms.shape[1]
    matrix = np.zeros((size, size))
    for row in range(size):
        for column in range(size):
            for muscle in range(len(weight)):
                matrix[row, column] += arms[muscle, row] * weight[muscle] * arms[muscle, column]
        matrix[row, row] += diagonal[row]
    return matrix


@_compiled
def _slide(slid: float, travel: float, limit: float) -> float:
    return min(max(slid + travel, -limit), limit)


@_compiled
def pull(
    duration: float, position: np.ndarray, velocity: np.ndarray, solved_at: np.ndarray, lengths: np.ndarray,
    arms: np.ndarray, wires: np.ndarray, orders: np.ndarray, build: np.ndarray, slid_joint: np.ndarray,
    joints: np.ndarray, numbers: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Wind and stretch every wire for one step; the torques [N m] that wires, damping and friction bring, shape (n,).

    Args:
        duration: Of the step [s].
        position: Joint positions [rad], shape (n,).
        velocity: Joint velocities [rad/s], shape (n,).
        solved_at: Joint positions [rad] of the next two, shape (n,).
        lengths: Path lengths [m], shape (m,).
        arms: Moment arms [m/rad], shape (m, n).
        wires: Spool position [m], tension of the elastic element [N], what the load cell reads [N], and how far wire
            and guide have slid [m], shape (5, m); moved on in place.
        orders: Target of the spool [m], whether it follows (1 or 0), the longest its elastic element can get [m], and
            whether the wire is whole (1 or 0), shape (4, m).
        build: Scale [N] and rate [1/m] of the elastic elements, friction of wires and guides (shares), shape (4, m).
        slid_joint: How far the joints have slid [rad], shape (n,); moved on in place.
        joints: Damping [N m s/rad] and dry friction [N m], shape (2, n).
        numbers: Highest speed [m/s] and lag [s] of a spool, loss time of the elastic elements [s], and presliding of
            wires [m], guides [m] and joints [rad], shape (6,).
    """
    speed, lag, loss_time, wire_limit, guide_limit, joint_limit = numbers
    size = len(position)
    torque = np.empty(size)
    for joint in range(size):
        slid_joint[joint] = _slide(slid_joint[joint], velocity[joint] * duration, joint_limit)
        friction = joints[1, joint] * slid_joint[joint] / joint_limit
        torque[joint] = -joints[0, joint] * velocity[joint] - friction
    reach, share = speed * duration, duration / (duration + lag)
    for muscle in range(len(lengths)):
        path, path_rate = lengths[muscle], 0.0
        for joint in range(size):
            ahead = position[joint] - solved_at[joint] + duration * velocity[joint]
            path += arms[muscle, joint] * ahead
            path_rate += arms[muscle, joint] * velocity[joint]
        target, follows, grip, whole = orders[:, muscle]
        scale, rate, wire_share, guide_share = build[:, muscle]
        move = min(max((target - wires[0, muscle]) * share, -reach), reach) * follows
        spool = wires[0, muscle] + move
        if whole > 0.0:  # a cut wire does not drag its spool
            spool = max(spool, path - grip)
        paid_out = spool - wires[0, muscle]
        loss = min(max(1.0 + loss_time * rate * (path_rate - paid_out / duration), 0.0), 1.5)
        force = scale * math.expm1(rate * max(path - spool, 0.0)) * loss * whole
        wires[3, muscle] = _slide(wires[3, muscle], path_rate * duration, wire_limit)
        wires[4, muscle] = _slide(wires[4, muscle], paid_out, guide_limit)
        wires[0, muscle], wires[1, muscle] = spool, force
        wires[2, muscle] = force * (1.0 - guide_share * wires[4, muscle] / guide_limit)
        force *= 1.0 + wire_share * wires[3, muscle] / wire_limit
        for joint in range(size):
            torque[joint] -= force * arms[muscle, joint]
    return torque
