"""Resting states of the robot: deflection in one pass, tool tip, centre of gravity, image; many postures at once.

As in the paper's simulation, torques are those of gravity at the commanded posture, and each joint gives way by its
deflection per torque in one pass. The equilibrium, where torques are those of the posture that results, does
not exist at the paper's 30 degrees per N m: the ankles buckle under a body of 1.8 kg.
"""

from dataclasses import dataclass

import numpy as np

from simulators.chain import GRAVITY
from simulators.robots.kxr_humanoid.body import ORDER, Body, Camera, Tool


@dataclass(frozen=True, slots=True)
class Rest:
    """Resting states, one per row.

    Attributes:
        joints: Positions of the links, deflection included, in the order of the command [rad], shape (n, 4).
        tip: Tool tip in the frame of the feet [m], shape (n, 3).
        center: Centre of gravity on the ground, in the frame of the feet [m], shape (n, 2).
        weight: Weight of robot and tool [N].
        pixel: Tool tip in the image [px], shape (n, 2), also beyond its edges; NaN behind the camera.
    """

    joints: np.ndarray
    tip: np.ndarray
    center: np.ndarray
    weight: float
    pixel: np.ndarray


def rest(body: Body, tool: Tool, command: np.ndarray, stiff: bool = False) -> Rest:
    """Return the resting states of commands.

    Args:
        body: The robot.
        tool: The held tool.
        command: Motor-side joint positions: shoulder pitch, shoulder yaw, elbow pitch, ankle pitch [rad], shape (n, 4).
        stiff: Whether to leave out deflection, as a geometric model does.
    """
    joints = np.empty((len(command), 4))
    joints[:, ORDER] = command
    joints += body.joint_zero
    if not stiff:
        joints += body.deflection * _gravity_torques(body, tool, joints)
    frames = body.chain.frames(joints)
    tip = _held(body, frames, tool.length)
    moments, masses = _moments(body, tool, frames)
    mass = float(masses.sum()) + body.foot_mass
    center = (moments.sum(axis=0)[:, :2] + body.foot_mass * body.foot_center) / mass
    return Rest(joints[:, ORDER], tip, center, GRAVITY * mass, _image(body.camera, frames, tip))


Frames = tuple[np.ndarray, np.ndarray]
"""Frames are orientations (5, n, 3, 3) and origins (5, n, 3) of feet, body, shoulder, upper arm and forearm."""


def _image(camera: Camera, frames: Frames, tip: np.ndarray) -> np.ndarray:
    """Return the image of the tips [m], shape (n, 3): u to the right, v down [px], shape (n, 2)."""
    rotations, origins = frames
    seen = np.matmul((tip - origins[1])[:, None, :], rotations[1])[:, 0] - camera.position
    depth, down, right = (seen @ camera.axes).T
    scale = camera.focal / np.where(depth > _NEAREST, depth, np.nan)
    return np.column_stack([camera.width / 2 + scale * right, camera.height / 2 + scale * down])


def is_in_view(camera: Camera, pixel: np.ndarray) -> np.ndarray:
    """Return which points of the image [px], shape (n, 2), lie within it, booleans, shape (n,)."""
    inside: np.ndarray = np.all((pixel >= 0) & (pixel <= (camera.width, camera.height)), axis=1)
    return inside


def _held(body: Body, frames: Frames, reach: float) -> np.ndarray:
    """Return points of the tool, `reach` [m] from the grip, in the frame of the feet [m], shape (n, 3)."""
    rotations, origins = frames
    point: np.ndarray = rotations[-1] @ (body.grip + reach * body.tool_direction) + origins[-1]
    return point


def _moments(body: Body, tool: Tool, frames: Frames) -> Frames:
    """Return the first moments of mass of the links, the tool with the last [kg m] (4, n, 3), and their masses [kg]
    (4,).
    """
    rotations, origins = frames
    chain = body.chain
    moments = np.matmul(rotations[1:], chain.centers[:, None, :, None])[..., 0] + origins[1:]
    moments *= chain.masses[:, None, None]
    moments[-1] += tool.mass * _held(body, frames, tool.length - tool.center)
    masses = chain.masses.copy()
    masses[-1] += tool.mass
    return moments, masses


def _gravity_torques(body: Body, tool: Tool, joints: np.ndarray) -> np.ndarray:
    """Return the torques by which gravity turns the joints, ankle first [N m], shape (n, 4), at positions [rad] of
    that shape.
    """
    frames = rotations, origins = body.chain.frames(joints)
    moments, masses = _moments(body, tool, frames)
    levers = moments[::-1].cumsum(axis=0)[::-1] - masses[::-1].cumsum()[::-1, None, None] * origins[1:]
    axes = np.matmul(rotations[:-1], body.chain.axes[:, None, :, None])[..., 0]
    torques: np.ndarray = GRAVITY * (axes[..., 1] * levers[..., 0] - axes[..., 0] * levers[..., 1])
    return torques.T


_NEAREST = 0.01
"""The camera sees points from this depth [m]."""
