"""The frames of a URDF as transforms: one per joint, from its parent link to its child link."""

import math
import xml.etree.ElementTree as Tree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal.finding.urdf import root_of
from services.errors import ServiceError

Numbers = tuple[float, ...]
MOVING = ("revolute", "continuous", "prismatic")
ZERO, IDENTITY = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint of a URDF.

    Attributes:
        place: Origin of the child's frame in that of the parent [m], shape (3,).
        turn: Rotation of the child's frame in the zero position, as a quaternion x, y, z, w.
        axis: Unit vector of the joint in the child's frame, shape (3,).
        mimics: Joint that it follows; empty if it has its own position.
        factor: Its position is that of the other joint times this factor.
        offset: This is added [rad or m].
    """

    name: str
    kind: str
    parent: str
    child: str
    place: Numbers
    turn: Numbers
    axis: Numbers
    mimics: str = ""
    factor: float = 1.0
    offset: float = 0.0


class Frames:
    """The frames of a URDF.

    Args:
        path: The URDF file.

    Attributes:
        text: Its text, for `robot_description`.
        joints: Its joints.
        links: Names of its links; the first is the root.

    Raises:
        ServiceError: The file cannot be read, or is not a URDF.
    """

    def __init__(self, path: Path) -> None:
        try:
            self.text = path.read_text()
            root = root_of(self.text)
            self.joints = tuple(_joint(element) for element in root.findall("joint"))
            names = [element.get("name", "") for element in root.findall("link")]
        except OSError as error:
            raise ServiceError(f"The URDF '{path}' cannot be read: {error.strerror}.") from None
        except (Tree.ParseError, ValueError, AttributeError) as error:
            raise ServiceError(f"The URDF '{path}' cannot be read: {error}.") from None
        children = {joint.child for joint in self.joints}
        self.links = tuple(sorted(dict.fromkeys(names), key=lambda link: link in children))

    def fixed(self) -> Iterator[dict[str, Any]]:
        """Return the transforms that never change, without a header."""
        for joint in self.joints:
            if joint.kind == "fixed":
                yield _transform(joint, 0.0)

    def moved(self, positions: Mapping[str, float]) -> Iterator[dict[str, Any]]:
        """Return the transforms of the joints whose positions [rad or m] are given, without a header."""
        for joint in self.joints:
            source = joint.mimics or joint.name
            if joint.kind in MOVING and source in positions:
                yield _transform(joint, joint.factor * positions[source] + joint.offset)

    def carriers(self) -> dict[str, frozenset[str]]:
        """Return link -> movable joints between the root and it, of which each has a position of its own."""
        above = {joint.child: joint for joint in self.joints}
        carriers: dict[str, frozenset[str]] = {}

        def of(link: str) -> frozenset[str]:
            if link not in carriers:
                carriers[link] = frozenset()  # ends a circle of links
                if (joint := above.get(link)) is not None:
                    own = {joint.mimics or joint.name} if joint.kind in MOVING else set()
                    carriers[link] = of(joint.parent) | own
            return carriers[link]

        return {link: of(link) for link in self.links}

    def poses(self, positions: Mapping[str, float]) -> dict[str, tuple[Numbers, Numbers]]:
        """Return link -> its place [m] and its rotation x, y, z, w in the frame of the root.

        Args:
            positions: Joint -> position [rad or m]; the others are at zero.
        """
        poses: dict[str, tuple[Numbers, Numbers]] = dict.fromkeys(self.links[:1], (ZERO, IDENTITY))
        waiting = list(self.joints)
        while waiting:
            ready = [joint for joint in waiting if joint.parent in poses]
            if not ready:
                break  # these joints hang on no link of the tree
            for joint in ready:
                place, turn = poses[joint.parent]
                source = joint.mimics or joint.name
                own, rotation = _moved(joint, joint.factor * positions.get(source, 0.0) + joint.offset)
                shift = _rotated(turn, own)
                poses[joint.child] = tuple(map(sum, zip(place, shift, strict=True))), _product(turn, rotation)
            waiting = [joint for joint in waiting if joint.child not in poses]
        return poses

    def point(self, poses: Mapping[str, tuple[Numbers, Numbers]], link: str, place: Numbers) -> Numbers:
        """Return a point of a link's frame in the frame of the root [m], shape (3,)."""
        origin, turn = poses[link]
        return tuple(map(sum, zip(origin, _rotated(turn, place), strict=True)))


def _joint(element: Tree.Element) -> Joint:
    def numbers(child: str, attribute: str, default: str) -> Numbers:
        part = element.find(child)
        three = tuple(float(word) for word in (default if part is None else part.get(attribute, default)).split())
        if len(three) != 3 or not all(map(math.isfinite, three)):
            raise ValueError(f"joint '{element.get('name')}' has no three numbers in {child} {attribute}")
        return three

    axis = numbers("axis", "xyz", "1 0 0")
    length = math.hypot(*axis) or 1.0
    mimic = element.find("mimic")
    parent, child = (element.find(name).get("link") for name in ("parent", "child"))  # type: ignore[union-attr]
    return Joint(
        name=element.get("name", ""),
        kind=element.get("type", ""),
        parent=parent or "",
        child=child or "",
        place=numbers("origin", "xyz", "0 0 0"),
        turn=_quaternion(numbers("origin", "rpy", "0 0 0")),
        axis=tuple(one / length for one in axis),
        mimics="" if mimic is None else mimic.get("joint", ""),
        factor=1.0 if mimic is None else float(mimic.get("multiplier", 1.0)),
        offset=0.0 if mimic is None else float(mimic.get("offset", 0.0)),
    )


def _moved(joint: Joint, position: float) -> tuple[Numbers, Numbers]:
    """Return place [m] and rotation of a joint's child in the frame of its parent at a position [rad or m]."""
    place, turn = joint.place, joint.turn
    if joint.kind == "prismatic":
        step = _rotated(turn, joint.axis)
        place = tuple(at + position * along for at, along in zip(place, step, strict=True))
    elif joint.kind in MOVING:
        half = 0.5 * position
        turn = _product(turn, (*(math.sin(half) * part for part in joint.axis), math.cos(half)))
    return place, turn


def _transform(joint: Joint, position: float) -> dict[str, Any]:
    """Return the transform of a joint at a position [rad or m]."""
    place, turn = _moved(joint, position)
    return {
        "parent": joint.parent,
        "child_frame_id": joint.child,
        "transform": {
            "translation": dict(zip("xyz", place, strict=True)),
            "rotation": dict(zip("xyzw", turn, strict=True)),
        },
    }


def _quaternion(rpy: Numbers) -> Numbers:
    """Return the quaternion x, y, z, w of roll, pitch and yaw [rad] around the fixed axes."""
    turned: Numbers = IDENTITY
    for index, angle in enumerate(rpy):
        axis = [0.0, 0.0, 0.0]
        axis[index] = math.sin(0.5 * angle)
        turned = _product((*axis, math.cos(0.5 * angle)), turned)
    return turned


def _product(left: Numbers, right: Numbers) -> Numbers:
    """Return the product of two quaternions x, y, z, w."""
    a, b, c, w = left
    x, y, z, v = right
    return (
        w * x + a * v + b * z - c * y,
        w * y - a * z + b * v + c * x,
        w * z + a * y - b * x + c * v,
        w * v - a * x - b * y - c * z,
    )


def _rotated(turn: Numbers, vector: Numbers) -> Numbers:
    """Return a vector, shape (3,), rotated by a quaternion."""
    back = (-turn[0], -turn[1], -turn[2], turn[3])
    return _product(_product(turn, (*vector, 0.0)), back)[:3]
