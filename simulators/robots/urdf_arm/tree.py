"""A URDF as a tree of links and joints; what it cannot describe is refused in one sentence."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from hal.errors import ConfigError
from hal.finding.urdf import drop_extensions, root_of

TURNING = ("revolute", "continuous")
OTHERS = {
    "sdf": "an SDF file of Gazebo",
    "COLLADA": "a COLLADA file",
    "mujocoinclude": "a part that another MJCF file includes",
}
"""Root elements of files that are taken for a URDF, and their names."""


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint of a URDF.

    Attributes:
        name: Its name.
        kind: `revolute`, `continuous`, `prismatic`, `fixed`, `floating` or `planar`.
        parent: Link before it.
        child: Link behind it.
        turn: Orientation of its frame in that of the parent, shape (3, 3).
        shift: Origin of its frame in that of the parent [m], shape (3,).
        axis: Axis in its own frame, a unit vector, shape (3,).
        low: Lowest position [rad or m]; minus half a turn if it is continuous.
        high: Highest position [rad or m].
        effort: Largest effort [N m or N]; 0 if not stated.
        velocity: Largest velocity [rad/s or m/s]; 0 if not stated.
        follows: Joint that it mimics; empty if it has a motor of its own.
    """

    name: str
    kind: str
    parent: str
    child: str
    turn: np.ndarray
    shift: np.ndarray
    axis: np.ndarray
    low: float
    high: float
    effort: float
    velocity: float
    follows: str = ""

    @property
    def is_driven(self) -> bool:
        """Whether it turns by a motor of its own."""
        return self.kind in TURNING and not self.follows

    @property
    def rest(self) -> float:
        """Position at which it is held if it is not part of the arm [rad or m]: 0 if the limits allow it."""
        return min(max(0.0, self.low), self.high)


@dataclass(frozen=True, slots=True)
class Tree:
    """Links and joints of a URDF.

    Attributes:
        path: The file.
        name: Name of the robot in the file; empty without one.
        root: Link without a parent.
        links: Link -> its element of the file.
        behind: Link -> joints to the links behind it.
        before: Link -> joint to the link before it; the root has none.
    """

    path: Path
    name: str
    root: str
    links: Mapping[str, Element]
    behind: Mapping[str, tuple[Joint, ...]]
    before: Mapping[str, Joint]

    def way(self, link: str) -> tuple[Joint, ...]:
        """Return the joints from the root to a link."""
        joints: list[Joint] = []
        while link in self.before:
            joints.append(self.before[link])
            link = joints[-1].parent
        return tuple(reversed(joints))

    def leaves(self) -> Iterator[str]:
        """Yield every link without a link behind it."""
        yield from (link for link in self.links if not self.behind[link])


def read_tree(path: Path) -> Tree:
    """Read a URDF.

    Raises:
        ConfigError: It is missing, is no URDF, or its links and joints are no tree.
    """
    return tree_of(_parsed(path), path)


def tree_of(root: Element, path: Path) -> Tree:
    """Return the tree of a URDF that was read from, or made of, a file.

    Raises:
        ConfigError: Its links and joints are no tree.
    """
    links = {str(link.get("name")): link for link in root.findall("link")}
    joints = [_joint(element, path) for element in root.findall("joint")]
    before: dict[str, Joint] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise ConfigError(f"'{path}': joint '{joint.name}' names the link '{link}', which the file lacks.")
        if joint.child in before:
            other = before[joint.child].name
            raise ConfigError(
                f"'{path}': joints '{other}' and '{joint.name}' both lead to the link '{joint.child}', but a URDF is "
                "a tree."
            )
        before[joint.child] = joint
    roots = [link for link in links if link not in before]
    if len(roots) != 1:
        what = f"the links {', '.join(roots[:4])} without a joint to them" if roots else "a ring of joints"
        raise ConfigError(f"'{path}' has {what}, but a URDF is a tree with one root.")
    behind = {link: tuple(joint for joint in joints if joint.parent == link) for link in links}
    return Tree(path, root.get("name") or "", roots[0], links, behind, before)


def _parsed(path: Path) -> Element:
    if path.is_dir():
        raise ConfigError(f"'{path}' is a folder. Give the URDF file in it.")
    try:
        root = root_of(path.read_bytes())
    except FileNotFoundError:
        raise ConfigError(f"There is no file '{path}'. Is its folder right?") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"'{path}' cannot be read: {error}.") from None
    except ElementTree.ParseError as error:
        raise ConfigError(f"'{path}' is not XML: {error}. Is it a URDF?") from None
    texts = ("".join(element.attrib.values()) for element in root.iter())
    is_macro = any("xacro" in element.tag for element in root.iter()) or any("${" in t or "$(" in t for t in texts)
    if is_macro or path.name.endswith(".xacro"):
        raise ConfigError(f"'{path}' is a xacro file. Convert it first: xacro {path.name} > robot.urdf")
    if root.tag != "robot":
        if root.tag == "mujoco":
            raise ConfigError(f"'{path}' is an MJCF file of MuJoCo. `gemuco init` makes a URDF of it.")
        kind = OTHERS.get(root.tag.rpartition("}")[2], f"XML of <{root.tag}>")
        raise ConfigError(
            f"'{path}' is {kind}, but `gemuco init` needs a URDF, whose root is <robot>, or an MJCF file of MuJoCo."
        )
    if root.find("link") is None:
        raise ConfigError(f"'{path}' has no link, so it describes no robot.")
    drop_extensions(root)
    return root


def _joint(element: Element, path: Path) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    where = f"'{path}': joint '{name}'"
    origin, axis, limit, mimic = (element.find(tag) for tag in ("origin", "axis", "limit", "mimic"))
    ends = [element.find(tag) for tag in ("parent", "child")]
    if any(end is None for end in ends):
        raise ConfigError(f"{where} has no parent or no child link.")
    parent, child = (str(end.get("link")) for end in ends if end is not None)
    placed: Mapping[str, str] = {} if origin is None else origin.attrib
    direction = numbers(None if axis is None else axis.get("xyz"), (1.0, 0.0, 0.0), where)
    length = float(np.linalg.norm(direction))
    if length == 0.0 and kind in (*TURNING, "prismatic"):
        raise ConfigError(f"{where} has an axis of length 0.")
    bounds: Mapping[str, str] = {} if limit is None else limit.attrib
    low, high, effort, velocity = (_number(bounds.get(key), where) for key in ("lower", "upper", "effort", "velocity"))
    if kind == "continuous" or not low < high:  # some files leave the limits of a revolute joint at 0
        low, high = -math.pi, math.pi
    return Joint(
        name=name,
        kind=kind,
        parent=parent,
        child=child,
        turn=rotation(numbers(placed.get("rpy"), (0.0, 0.0, 0.0), where)),
        shift=numbers(placed.get("xyz"), (0.0, 0.0, 0.0), where),
        axis=direction / length if length else direction,
        low=low,
        high=high,
        effort=max(effort, 0.0),
        velocity=max(velocity, 0.0),
        follows="" if mimic is None else mimic.get("joint", "another"),
    )


def numbers(text: str | None, default: tuple[float, ...], where: str) -> np.ndarray:
    """Return numbers that are written with spaces between, or the default for None.

    Raises:
        ConfigError: They are not numbers, or not as many as the default has.
    """
    words = (text or "").split()
    if text is None or not words:
        return np.array(default)
    values = [_number(word, where) for word in words]
    if len(values) != len(default):
        raise ConfigError(f"{where} has '{text}', where {len(default)} numbers belong.")
    return np.array(values)


def _number(text: str | None, where: str) -> float:
    try:
        value = float(text or 0.0)
    except ValueError:
        raise ConfigError(f"{where} has '{text}' in place of a number.") from None
    return value if math.isfinite(value) else math.copysign(0.0 if math.isnan(value) else 1e3, value)


def rotation(rpy: np.ndarray) -> np.ndarray:
    """Return the orientation of roll, pitch and yaw [rad], shape (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def cross_matrix(axis: np.ndarray) -> np.ndarray:
    """Return the matrix of the cross product with a vector, shape (3, 3)."""
    return np.cross(np.eye(3), axis)


def turned(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation by an angle [rad] around a unit vector, shape (3, 3)."""
    cross = cross_matrix(axis)
    turn: np.ndarray = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    return turn
