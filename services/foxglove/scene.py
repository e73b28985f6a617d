"""The robot in Foxglove's 3D panel: a rod for each link, painted by the origin of its joints, its wires and points."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from foxglove.messages import (
    Color,
    CylinderPrimitive,
    Duration,
    FrameTransform,
    FrameTransforms,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    Timestamp,
    Vector3,
)

from services.watch.frames import IDENTITY, ZERO, Frames, Numbers
from services.watch.shapes import BALL, KNOB, ROD, Shapes, Wires
from services.watch.shapes import Color as Rgba
from services.watch.signal_rows import SignalRow


class RobotScene:
    """Frames and shapes of one robot as Foxglove's messages.

    Args:
        frames: Frames of its URDF; None without one.
        wires: Its wires.

    Raises:
        ServiceError: A wire is on a link that the URDF lacks.
    """

    def __init__(self, frames: Frames | None, wires: Wires | None = None) -> None:
        self._frames = frames
        self.shapes = Shapes(frames, wires)

    def transforms(self, stamp_ns: int) -> FrameTransforms:
        """Return all frames at the present positions; `stamp_ns` is a time [ns since 1970]."""
        if self._frames is None:
            return FrameTransforms(transforms=[])
        moved = [*self._frames.fixed(), *self._frames.moved(self.shapes.positions())]
        return FrameTransforms(transforms=[_transform(frame, stamp_ns) for frame in moved])

    def update(self, rows: Sequence[SignalRow], stamp_ns: int, limits: Mapping[str, float]) -> SceneUpdate:
        """Return the links painted by what is known of their joints, the wires by their tension, and the points.

        Args:
            rows: Rows of all elements.
            stamp_ns: Time [ns since 1970].
            limits: Signal -> tension [N] at which a wire has its last color.
        """
        stamp = _stamp(stamp_ns)
        entities = [*self._links(rows, stamp), *self._wires(rows, stamp, limits), *self._points(rows, stamp)]
        return SceneUpdate(entities=entities, deletions=[])

    def _links(self, rows: Sequence[SignalRow], stamp: Timestamp) -> Iterable[SceneEntity]:
        shapes = self.shapes
        for link, rgba in shapes.colors(rows).items():
            color = _painted(rgba)
            knob = SpherePrimitive(pose=_pose(ZERO, IDENTITY), size=_cube(2.0 * KNOB * shapes.thick), color=color)
            rods = [_rod(end, ROD * shapes.thick, color) for end in shapes.rods.get(link, ())]
            yield _entity(stamp, link, f"link {link}", spheres=[knob], cylinders=rods)

    def _wires(self, rows: Sequence[SignalRow], stamp: Timestamp, limits: Mapping[str, float]) -> Iterable[SceneEntity]:
        lines = [
            LinePrimitive(
                type=LinePrimitiveLineType.LineStrip, thickness=3.0, scale_invariant=True,
                points=[Point3(x=x, y=y, z=z) for x, y, z in line.points], color=_painted(line.color),
            )
            for line in self.shapes.lines(rows, limits)
        ]  # fmt: skip
        if lines:
            yield _entity(stamp, self.shapes.root, "wires", lines=lines)

    def _points(self, rows: Sequence[SignalRow], stamp: Timestamp) -> Iterable[SceneEntity]:
        size = _cube(2.0 * BALL * self.shapes.thick)
        for point in self.shapes.points(rows):
            color = _painted(point.color)
            balls = (
                []
                if point.place is None
                else [SpherePrimitive(pose=_pose(point.place, IDENTITY), size=size, color=color)]
            )
            yield _entity(stamp, self.shapes.root, point.signal, spheres=balls)


def _entity(stamp: Timestamp, frame: str, name: str, **shapes: Any) -> SceneEntity:
    return SceneEntity(timestamp=stamp, frame_id=frame, id=name, frame_locked=True, lifetime=Duration(0), **shapes)


def _painted(color: Rgba) -> Color:
    red, green, blue, opacity = color
    return Color(r=red, g=green, b=blue, a=opacity)


def _stamp(stamp_ns: int) -> Timestamp:
    return Timestamp(stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)


def _transform(frame: Mapping[str, Mapping[str, Mapping[str, float]]], stamp_ns: int) -> FrameTransform:
    transform = frame["transform"]
    return FrameTransform(
        timestamp=_stamp(stamp_ns),
        parent_frame_id=str(frame["parent"]),
        child_frame_id=str(frame["child_frame_id"]),
        translation=Vector3(**transform["translation"]),
        rotation=Quaternion(**transform["rotation"]),
    )


def _pose(place: Numbers, turn: Numbers) -> Pose:
    return Pose(
        position=Vector3(**dict(zip("xyz", place, strict=True))),
        orientation=Quaternion(**dict(zip("xyzw", turn, strict=True))),
    )


def _cube(size: float) -> Vector3:
    return Vector3(x=size, y=size, z=size)


def _rod(end: Numbers, radius: float, color: Color) -> CylinderPrimitive:
    """Return a cylinder from the origin of a frame to `end` [m]."""
    place, turn, length = rod_pose(end)
    size = Vector3(x=2.0 * radius, y=2.0 * radius, z=length)
    return CylinderPrimitive(pose=_pose(place, turn), size=size, bottom_scale=1.0, top_scale=1.0, color=color)


def rod_pose(end: Numbers) -> tuple[Numbers, Numbers, float]:
    """Return middle [m], rotation x, y, z, w, and length [m] of a cylinder along z that ends at 0 and `end` [m]."""
    length = math.hypot(*end)
    x, y, z = (part / length for part in end)
    turn = (1.0, 0.0, 0.0, 0.0) if z < -0.999999 else _unit((-y, x, 0.0, 1.0 + z))
    return tuple(0.5 * part for part in end), turn, length


def _unit(turn: Numbers) -> Numbers:
    length = math.hypot(*turn)
    return tuple(part / length for part in turn)
