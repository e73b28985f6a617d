"""ROS 2 messages made of a robot's signals. What is not measured is absent, or NaN where a place cannot be left out."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

Message = dict[str, Any]

JOINT_STATE = "sensor_msgs/msg/JointState"
NUMBERS = "std_msgs/msg/Float64MultiArray"
POINT = "geometry_msgs/msg/PointStamped"
WRENCH = "geometry_msgs/msg/WrenchStamped"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
JOINTS = {"joint_position": "position", "joint_velocity": "velocity", "joint_effort": "effort"}
"""These signals are the fields of a JointState."""
AXES = ("x", "y", "z")
FORCES = ("fx", "fy", "fz", "tx", "ty", "tz")
"""A signal with these elements is a whole wrench."""
NANOSECONDS = 1_000_000_000


def stamp(time_ns: int) -> Message:
    """Return a time [ns since 1970] as builtin_interfaces/msg/Time."""
    seconds, rest = divmod(time_ns, NANOSECONDS)
    return {"sec": seconds, "nanosec": rest}


def time_ns(stamp_: Mapping[str, int]) -> int:
    """Return a builtin_interfaces/msg/Time in ns since 1970."""
    return stamp_["sec"] * NANOSECONDS + stamp_["nanosec"]


def header(stamp_ns: int, frame: str = "") -> Message:
    """Return a header with a time [ns since 1970] and a frame."""
    return {"stamp": stamp(stamp_ns), "frame_id": frame}


def joint_state(stamp_ns: int, joints: Mapping[str, Mapping[str, float]]) -> Message | None:
    """Return a JointState; None without a joint.

    Args:
        stamp_ns: Time of the measurement [ns since 1970].
        joints: Joint -> field (`position`, `velocity`, `effort`) -> value [SI]. If a field is known of some joint, it
            is NaN for the joints of which it is not.
    """
    if not joints:
        return None
    message: Message = {"header": header(stamp_ns), "name": list(joints)}
    for field in JOINTS.values():
        is_known = any(field in values for values in joints.values())
        message[field] = [values.get(field, math.nan) for values in joints.values()] if is_known else []
    return message


def numbers(labels: Sequence[str], values: Sequence[float] | np.ndarray) -> Message:
    """Return a Float64MultiArray of one dimension; its label names the elements."""
    size = len(values)
    dimension = {"label": ",".join(labels), "size": size, "stride": size}
    return {"layout": {"dim": [dimension], "data_offset": 0}, "data": np.asarray(values, float)}


def point(stamp_ns: int, frame: str, place: Sequence[float]) -> Message:
    """Return a PointStamped of three coordinates [m]."""
    return {"header": header(stamp_ns, frame), "point": dict(zip(AXES, place, strict=True))}


def wrench(stamp_ns: int, frame: str, values: Mapping[str, float]) -> Message:
    """Return a WrenchStamped.

    Args:
        stamp_ns: Time of the measurement [ns since 1970].
        frame: Frame of the cell.
        values: `fx` to `tz` -> force [N] or torque [N m]; the others are NaN, as a cell of one axis measures only that.
    """
    six = [values.get(name, math.nan) for name in FORCES]
    vectors = {name: dict(zip(AXES, part, strict=True)) for name, part in (("force", six[:3]), ("torque", six[3:]))}
    return {"header": header(stamp_ns, frame), "wrench": vectors}


def status(name: str, robot: str, level: int, text: str, values: Mapping[str, object]) -> Message:
    """Return a DiagnosticStatus; `level` is 0 for OK, 1 for a warning, 2 for an error, 3 for stale."""
    pairs = [
        {"key": key, "value": f"{value:.6g}" if isinstance(value, float) else str(value)}
        for key, value in values.items()
    ]
    return {"level": level, "name": name, "message": text, "hardware_id": robot, "values": pairs}


def trajectory(stamp_ns: int, names: Iterable[str], positions: np.ndarray, after: float) -> Message:
    """Return a JointTrajectory of one point that is reached `after` [s] its stamp; shape (n,) [rad or m]."""
    seconds, rest = divmod(round(after * NANOSECONDS), NANOSECONDS)
    point_ = {
        "positions": positions, "velocities": (), "accelerations": (), "effort": (),
        "time_from_start": {"sec": seconds, "nanosec": rest},
    }  # fmt: skip
    return {"header": header(stamp_ns), "joint_names": list(names), "points": [point_]}
