"""Shapes of a robot for 3D views: links as rods, wires and points, with the color of what is known of them."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from services.errors import ServiceError
from services.watch.frames import Frames, Numbers
from services.watch.signal_rows import Kind, SignalRow

ROD, KNOB, BALL = 0.09, 0.13, 0.2
"""Rods, joints and points have these radii, as a share of the mean length of the robot's links."""
SHORT = 1e-3
"""Links shorter than this [m] have no rod."""
Color = tuple[float, float, float, float]
"""Red, green, blue and opacity, 0 to 1."""
BLUE, AMBER = (0.36, 0.63, 0.9, 1.0), (1.0, 0.69, 0.29, 1.0)
GREY, UNKNOWN = (0.41, 0.44, 0.49, 1.0), (0.41, 0.44, 0.49, 0.35)
"""Links with the second color have an unknown position and stay at the last one."""
SLACK, HALF, FULL = (20, 70, 230), (255, 160, 0), (255, 20, 0)
"""Colors of a wire without tension, at a quarter of the full tension, and at the full one."""
FULL_TENSION = 100.0
"""Wires without a limit have their last color at this tension [N]."""
AXES = ("x", "y", "z")
"""A signal in m with these elements is shown as a point in the frame of the root."""

Wires = Mapping[str, Sequence[tuple[str, float, float, float]]]
"""Element of the tension signal -> points of its wire: link, and place in its frame [m]."""


@dataclass(frozen=True, slots=True)
class Line:
    """A wire: its points in the frame of the root [m], and its color."""

    name: str
    points: tuple[Numbers, ...]
    color: Color


@dataclass(frozen=True, slots=True)
class Point:
    """A signal that is a place in the frame of the root [m]; None while it is not known."""

    signal: str
    place: Numbers | None
    color: Color


class Shapes:
    """Links, wires and points of one robot.

    Args:
        frames: Frames of its URDF; None without one.
        wires: Its wires.

    Attributes:
        root: Name of the frame of the root.
        rods: Link -> ends of its rods in its frame [m].
        thick: Mean length of its links [m], or half of it with wires; sizes are shares of it.

    Raises:
        ServiceError: A wire is on a link that the URDF lacks.
    """

    def __init__(self, frames: Frames | None, wires: Wires | None = None) -> None:
        self._frames, self._wires = frames, dict(wires or {}) if frames is not None else {}
        self._positions: dict[str, float] = {}
        self.root = "base" if frames is None else frames.links[0]
        self._carriers = {} if frames is None else frames.carriers()
        self._moving = frozenset().union(*self._carriers.values()) if self._carriers else frozenset()
        ends: dict[str, list[Numbers]] = {} if frames is None else {link: [] for link in frames.links}
        for joint in () if frames is None else frames.joints:
            ends.setdefault(joint.parent, []).append(joint.place)
        self.rods = {link: [end for end in own if math.hypot(*end) > SHORT] for link, own in ends.items()}
        strangers = {link for route in self._wires.values() for link, *_ in route} - set(self._carriers)
        if strangers:
            known = ", ".join(self._carriers)
            raise ServiceError(f"A wire is on link '{min(strangers)}', which the URDF lacks. Links: {known}.")
        lengths = [math.hypot(*end) for own in self.rods.values() for end in own]
        self.thick = (sum(lengths) / len(lengths) if lengths else 0.1) * (0.5 if self._wires else 1.0)

    @property
    def has_wires(self) -> bool:
        """Whether wires are drawn, which change their color with every sample."""
        return bool(self._wires)

    def follow(self, rows: Iterable[SignalRow]) -> None:
        """Take the present positions; a joint whose position is not known stays."""
        seen = set()
        for row in rows:
            if row.element in self._moving and row.unit in ("rad", "m") and row.element not in seen:
                seen.add(row.element)
                if row.kind in (Kind.MEASURED, Kind.ESTIMATED) and math.isfinite(row.value):
                    self._positions[row.element] = row.value

    def positions(self) -> dict[str, float]:
        """Return joint -> position [rad or m]; 0 for one that was never known."""
        return {name: self._positions.get(name, 0.0) for name in self._moving}

    def colors(self, rows: Iterable[SignalRow]) -> dict[str, Color]:
        """Return link -> its color, by the origin of the joints that carry it."""
        kinds: dict[str, Kind] = {}
        for row in rows:
            if row.unit in ("rad", "m"):
                kinds.setdefault(row.element, row.kind)
        return {link: _color(carriers, kinds) for link, carriers in self._carriers.items()}

    def lines(self, rows: Sequence[SignalRow], limits: Mapping[str, float]) -> Iterator[Line]:
        """Yield the wires.

        Args:
            rows: Rows of all elements.
            limits: Signal -> tension [N] at which a wire has its last color.
        """
        if not self._wires or self._frames is None:
            return
        tensions = {row.element: row for row in rows if row.unit == "N"}
        poses = self._frames.poses(self.positions())
        for name, route in self._wires.items():
            points = tuple(self._frames.point(poses, link, tuple(place)) for link, *place in route)
            row = tensions.get(name)
            full = limits.get(row.signal, FULL_TENSION) if row is not None else FULL_TENSION
            yield Line(name, points, _tension(row, full))

    def points(self, rows: Sequence[SignalRow]) -> Iterator[Point]:
        """Yield the signals that are places."""
        for signal in dict.fromkeys(row.signal for row in rows if row.unit == "m"):
            three = {row.element: row for row in rows if row.signal == signal}
            if tuple(three) != AXES:
                continue
            is_known = all(row.kind in (Kind.MEASURED, Kind.ESTIMATED) for row in three.values())
            is_estimated = any(row.kind is Kind.ESTIMATED for row in three.values())
            place = tuple(three[axis].value for axis in AXES) if is_known else None
            yield Point(signal, place, AMBER if is_estimated else BLUE)


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
    return (red, green, blue, 1.0)
