"""The robot in Foxglove's 3D panel: a rod for each link, painted by the origin of its joints, its wires and points."""

import math
from collections.abc import Iterable, Mapping, Sequence

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

from services.errors import ServiceError
from services.watch.frames import IDENTITY, ZERO, Frames, Numbers
from services.watch.signal_rows import Kind, SignalRow

ROD, KNOB = 0.09, 0.13
"""Rods and joints have these radii, as a share of the mean length of the robot's links."""
SHORT = 1e-3
"""Links shorter than this [m] have no rod."""
BLUE, AMBER = Color(r=0.36, g=0.63, b=0.9, a=1.0), Color(r=1.0, g=0.69, b=0.29, a=1.0)
GREY, UNKNOWN = (Color(r=0.41, g=0.44, b=0.49, a=opacity) for opacity in (1.0, 0.35))
"""Links with this color have an unknown position and stay at the last one."""
SLACK, HALF, FULL = (20, 70, 230), (255, 160, 0), (255, 20, 0)
"""Colors of a wire without tension, at a quarter of the full tension, and at the full one."""
FULL_TENSION = 100.0
"""Wires without a limit have their last color at this tension [N]."""
AXES = ("x", "y", "z")
"""A signal in m with these elements is shown as a point in the frame of the root."""

Wires = Mapping[str, Sequence[tuple[str, float, float, float]]]
"""Element of the tension signal -> points of its wire: link, and place in its frame [m]."""


class RobotScene:
    """Frames and shapes of one robot.

    Args:
        frames: Frames of its URDF; None without one.
        wires: Its wires.

    Raises:
        ServiceError: A wire is on a link that the URDF lacks.
    """

    def __init__(self, frames: Frames | None, wires: Wires | None = None) -> None:
        self._frames, self._wires = frames, dict(wires or {}) if frames is not None else {}
        self._positions: dict[str, float] = {}
        self._root = "base" if frames is None else frames.links[0]
        self._carriers = {} if frames is None else frames.carriers()
        self._rods: dict[str, list[Numbers]] = {} if frames is None else {link: [] for link in frames.links}
        for joint in () if frames is None else frames.joints:
            self._rods.setdefault(joint.parent, []).append(joint.place)
        strangers = {link for route in self._wires.values() for link, *_ in route} - set(self._carriers)
        if strangers:
            known = ", ".join(self._carriers)
            raise ServiceError(f"A wire is on link '{min(strangers)}', which the URDF lacks. Links: {known}.")
        lengths = [math.hypot(*end) for ends in self._rods.values() for end in ends if math.hypot(*end) > SHORT]
        self._thick = (sum(lengths) / len(lengths) if lengths else 0.1) * (0.5 if self._wires else 1.0)

    @property
    def has_wires(self) -> bool:
        """Whether wires are drawn, which change their color with every sample."""
        return bool(self._wires)

    def follow(self, rows: Iterable[SignalRow]) -> None:
        """Take the present positions; a joint whose position is not known stays."""
        moving = frozenset().union(*self._carriers.values()) if self._carriers else frozenset()
        seen = set()
        for row in rows:
            if row.element in moving and row.unit in ("rad", "m") and row.element not in seen:
                seen.add(row.element)
                if row.kind in (Kind.MEASURED, Kind.ESTIMATED) and math.isfinite(row.value):
                    self._positions[row.element] = row.value

    def transforms(self, stamp_ns: int) -> FrameTransforms:
        """Return all frames at the present positions; `stamp_ns` is a time [ns since 1970]."""
        if self._frames is None:
            return FrameTransforms(transforms=[])
        moved = [*self._frames.fixed(), *self._frames.moved(self._every_position())]
        return FrameTransforms(transforms=[_transform(frame, stamp_ns) for frame in moved])

    def update(self, rows: Sequence[SignalRow], stamp_ns: int, limits: Mapping[str, float]) -> SceneUpdate:
        """Return the links painted by what is known of their joints, the wires by their tension, and the points.

        Args:
            rows: Rows of all elements.
            stamp_ns: Time [ns since 1970].
            limits: Signal -> tension [N] at which a wire has its last color.
        """
        stamp = _stamp(stamp_ns)
        entities = [*self._links(rows, stamp), *self._drawn_wires(rows, stamp, limits), *self._points(rows, stamp)]
        return SceneUpdate(entities=entities, deletions=[])

    def _every_position(self) -> dict[str, float]:
        moving = frozenset().union(*self._carriers.values()) if self._carriers else frozenset()
        return {name: self._positions.get(name, 0.0) for name in moving}

    def colors(self, rows: Iterable[SignalRow]) -> dict[str, Color]:
        """Return link -> its color, by the origin of the joints that carry it."""
        kinds: dict[str, Kind] = {}
        for row in rows:
            if row.unit in ("rad", "m"):
                kinds.setdefault(row.element, row.kind)
        return {link: _color(carriers, kinds) for link, carriers in self._carriers.items()}

    def _links(self, rows: Sequence[SignalRow], stamp: Timestamp) -> Iterable[SceneEntity]:
        for link, color in self.colors(rows).items():
            knob = SpherePrimitive(pose=_pose(ZERO, IDENTITY), size=_cube(2.0 * KNOB * self._thick), color=color)
            rods = [end for end in self._rods.get(link, ()) if math.hypot(*end) > SHORT]
            yield SceneEntity(
                timestamp=stamp, frame_id=link, id=f"link {link}", frame_locked=True, lifetime=Duration(0),
                spheres=[knob], cylinders=[_rod(end, ROD * self._thick, color) for end in rods],
            )  # fmt: skip

    def _drawn_wires(
        self, rows: Sequence[SignalRow], stamp: Timestamp, limits: Mapping[str, float]
    ) -> Iterable[SceneEntity]:
        if not self._wires or self._frames is None:
            return
        tensions = {row.element: row for row in rows if row.unit == "N"}
        poses, lines = self._frames.poses(self._every_position()), []
        for name, route in self._wires.items():
            points = [self._frames.point(poses, link, tuple(place)) for link, *place in route]
            row = tensions.get(name)
            lines.append(
                LinePrimitive(
                    type=LinePrimitiveLineType.LineStrip, thickness=3.0, scale_invariant=True,
                    points=[Point3(x=x, y=y, z=z) for x, y, z in points],
                    color=_tension(row, limits.get(row.signal, FULL_TENSION) if row is not None else FULL_TENSION),
                )
            )  # fmt: skip
        yield SceneEntity(
            timestamp=stamp, frame_id=self._root, id="wires", frame_locked=True, lifetime=Duration(0), lines=lines
        )

    def _points(self, rows: Sequence[SignalRow], stamp: Timestamp) -> Iterable[SceneEntity]:
        for signal in dict.fromkeys(row.signal for row in rows if row.unit == "m"):
            three = {row.element: row for row in rows if row.signal == signal}
            if tuple(three) != AXES:
                continue
            is_known = all(row.kind in (Kind.MEASURED, Kind.ESTIMATED) for row in three.values())
            is_estimated = any(row.kind is Kind.ESTIMATED for row in three.values())
            place = tuple(three[axis].value for axis in AXES)
            balls = [SpherePrimitive(pose=_pose(place, IDENTITY), size=_cube(0.4 * self._thick),
                                     color=AMBER if is_estimated else BLUE)] if is_known else []  # fmt: skip
            yield SceneEntity(
                timestamp=stamp, frame_id=self._root, id=signal, frame_locked=True, lifetime=Duration(0), spheres=balls
            )


def _color(carriers: frozenset[str], kinds: Mapping[str, Kind]) -> Color:
    """Return the color of a link by the origin of the joints that carry it."""
    below = {kinds.get(joint, Kind.MASKED) for joint in carriers}
    if not carriers:
        return GREY
    if below == {Kind.MEASURED}:
        return BLUE
    return AMBER if below <= {Kind.MEASURED, Kind.ESTIMATED} else UNKNOWN


def _tension(row: SignalRow | None, full: float) -> Color:
    """Return the color of a wire; by the square root, because a resting muscle has a small tension."""
    if row is None or row.kind is Kind.OLD or not math.isfinite(row.value):
        return UNKNOWN
    share = math.sqrt(min(max(row.value, 0.0) / full, 1.0))
    low, high, part = (SLACK, HALF, 2.0 * share) if share < 0.5 else (HALF, FULL, 2.0 * share - 1.0)
    red, green, blue = ((a + part * (b - a)) / 255.0 for a, b in zip(low, high, strict=True))
    return Color(r=red, g=green, b=blue, a=1.0)


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
