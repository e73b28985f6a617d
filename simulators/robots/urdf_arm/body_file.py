"""The URDF that the physics loads: one link per joint of the arm, with all that is fixed to it."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from simulators.robots.urdf_arm.choice import Arm
from simulators.robots.urdf_arm.tree import Joint, numbers, rotation, turned

MESHES = (".stl", ".obj", ".dae")
DENSITY = 1000.0
"""A link without an inertia, but with a shape, has this density [kg/m3]."""
MASSLESS = 1e-3
"""A link without an inertia and without a shape is a frame with this mass [kg]."""
SMALLEST = 1e-6
"""Moments of inertia are at least this [kg m2], because lighter links are not stable."""
LIGHT = 0.05
"""The moments of a link are at least this share of the largest of those behind it: servos that meet in a link of a
gram, as in a gimbal, do not hold the head behind it, because PyBullet solves one after the other."""
FALLBACK = 0.5
"""A link whose only shape is a mesh has this mass [kg] if the file states none."""

Pose = tuple[np.ndarray, np.ndarray]
"""Orientation, shape (3, 3), and place [m], shape (3,)."""


@dataclass(slots=True)
class Lump:
    """Links that are fixed to each other.

    Attributes:
        mass: Mass [kg].
        moment: Mass times centre of mass [kg m], in the lump's frame, shape (3,).
        inertia: Inertia around the origin of the lump's frame [kg m2], shape (3, 3).
        shapes: Collision shapes: pose and geometry.
    """

    mass: float = 0.0
    moment: np.ndarray = field(default_factory=lambda: np.zeros(3))
    inertia: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    shapes: list[tuple[Pose, Element]] = field(default_factory=list)

    def add(self, pose: Pose, mass: float, inertia: np.ndarray) -> None:
        """Add a body by the pose of its centre of mass, its mass [kg] and its inertia there [kg m2], shape (3, 3)."""
        turn, place = pose
        self.mass += mass
        self.moment += mass * place
        self.inertia += turn @ inertia @ turn.T + mass * _around(place)

    @property
    def center(self) -> np.ndarray:
        """Centre of mass [m], shape (3,)."""
        return self.moment / self.mass

    def central(self, least: float) -> np.ndarray:
        """Return the inertia around the centre of mass [kg m2], shape (3, 3), as a body can have it.

        Args:
            least: All moments are at least this [kg m2].
        """
        return possible(self.inertia - self.mass * _around(self.center), least)


def _around(place: np.ndarray) -> np.ndarray:
    inertia: np.ndarray = place @ place * np.eye(3) - np.outer(place, place)
    return inertia


def possible(inertia: np.ndarray, least: float = SMALLEST) -> np.ndarray:
    """Return the nearest inertia that a body can have, shape (3, 3), all of its moments at least `least` [kg m2]."""
    moments, axes = np.linalg.eigh(inertia)
    moments = np.maximum(moments, max(least, 0.01 * moments[2]))
    moments[2] = min(moments[2], 0.999 * (moments[0] + moments[1]))
    result: np.ndarray = (axes * moments) @ axes.T
    return result


def physics_urdf(arm: Arm, weights: Mapping[str, float] | None = None) -> tuple[str, list[str]]:
    """Return the text of the URDF, and sentences on what was missing in the original.

    Args:
        arm: The arm; its joints have the names of its elements.
        weights: Element of a joint -> factor of the mass of all that is fixed to the link behind it; others 1.
    """
    root = Element("robot", name="arm")
    guessed: list[str] = []
    lost: list[str] = []
    parts = []
    for name, joint, link, pose in _starts(arm):
        lump = Lump()
        for member, place in _members(arm, link):
            if not _add_inertia(lump, place, arm.tree.links[member]) and joint is not None:
                guessed.append(member)
            lost += _add_shapes(lump, place, arm.tree.links[member], arm.tree.path)
        parts.append((name or "base", joint, pose, lump))
    before = "base"
    for (own, joint, pose, lump), inertia in zip(parts, _inertias([lump for *_, lump in parts]), strict=True):
        _write_link(SubElement(root, "link", name=f"link {own}"), lump, inertia, (weights or {}).get(own, 1.0))
        if joint is not None:
            _write_joint(root, own, before, pose, joint.axis)
        before = own
    notes = []
    guessed = [link for link in guessed if arm.tree.links[link].find("visual") is not None]
    if guessed:
        notes.append(
            f"Mass or inertia of {_listed(guessed)} is guessed, because the file has none that a body can have."
        )
    if lost:
        notes.append(f"No contact of {_listed(sorted(set(lost)))}: the mesh was not found, or is not STL, OBJ or DAE.")
    ElementTree.indent(root)  # Bullet cannot read long lines
    return ElementTree.tostring(root, encoding="unicode"), notes


def _inertias(lumps: list[Lump]) -> list[np.ndarray]:
    """Return the inertia of each link of a chain around its centre of mass [kg m2], shapes (3, 3)."""
    inertias, least = [], SMALLEST
    for lump in reversed(lumps):
        inertias.append(lump.central(least))
        least = max(least, LIGHT * float(np.linalg.eigvalsh(inertias[-1])[-1]))
    return inertias[::-1]


def _listed(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _starts(arm: Arm) -> Iterator[tuple[str, Joint | None, str, Pose]]:
    """Yield element, joint, first link and pose in the lump before, of the base and of every joint."""
    tree, pose = arm.tree, (np.eye(3), np.zeros(3))
    yield "", None, tree.root, pose
    names = dict(zip((joint.name for joint in arm.joints), arm.names, strict=True))
    for joint in tree.way(arm.tip):
        pose = _behind(pose, joint, is_held=joint.name not in names)
        if joint.name in names:
            yield names[joint.name], joint, joint.child, pose
            pose = (np.eye(3), np.zeros(3))


def _behind(pose: Pose, joint: Joint, is_held: bool) -> Pose:
    """Return the pose of the frame of a joint, and of the link behind it if the joint is held."""
    turn, place = pose
    place, turn = place + turn @ joint.shift, turn @ joint.turn
    if is_held and joint.kind == "prismatic":
        place = place + turn @ (joint.axis * joint.rest)
    elif is_held and joint.kind in ("revolute", "continuous"):
        turn = turn @ turned(joint.axis, joint.rest)
    return turn, place


def _members(arm: Arm, link: str) -> Iterator[tuple[str, Pose]]:
    """Yield every link that is fixed to one, itself first, and its pose there; the arm's joints are not passed."""
    own = {joint.name for joint in arm.joints}
    members: list[tuple[str, Pose]] = [(link, (np.eye(3), np.zeros(3)))]
    for name, pose in members:
        yield name, pose
        for joint in arm.tree.behind[name]:
            if joint.name not in own:
                members.append((joint.child, _behind(pose, joint, is_held=True)))


def _placed(pose: Pose, element: Element | None) -> Pose:
    """Return a pose moved by an <origin>."""
    if element is None:
        return pose
    turn, place = pose
    shift, rpy = (numbers(element.get(key), (0.0, 0.0, 0.0), "an <origin>") for key in ("xyz", "rpy"))
    return turn @ rotation(rpy), place + turn @ shift


def _add_inertia(lump: Lump, pose: Pose, link: Element) -> bool:
    """Add a link's mass; return whether it states an inertia that a body can have."""
    name = str(link.get("name"))
    inertial = link.find("inertial")
    mass, matrix = (0.0, None) if inertial is None else _stated(inertial, name)
    if mass > 0.0 and matrix is not None and inertial is not None:
        lump.add(_placed(pose, inertial.find("origin")), mass, matrix)
        return True
    sizes = [size for shape in link.findall("collision") if (size := _size(shape, name)) is not None]
    shape = next((one for tag in ("collision", "visual") for one in link.findall(tag)), None)
    if mass <= 0.0:
        volume = sum(float(np.prod(size)) for size in sizes)
        mass = DENSITY * volume if sizes else FALLBACK if shape is not None else MASSLESS
    size = np.max(sizes, axis=0) if sizes else np.full(3, 0.1 if shape is not None else 0.01)
    origin = None if inertial is None else inertial.find("origin")
    origin = origin if origin is not None or shape is None else shape.find("origin")
    lump.add(_placed(pose, origin), mass, np.diag(mass / 12.0 * (np.sum(size**2) - size**2)))
    return False


def _stated(inertial: Element, name: str) -> tuple[float, np.ndarray | None]:
    """Return mass [kg] and inertia [kg m2] of an <inertial>; None if no body has this inertia."""
    mass_element, inertia = inertial.find("mass"), inertial.find("inertia")
    mass = float(numbers(None if mass_element is None else mass_element.get("value"), (0.0,), name)[0])
    if inertia is None:
        return mass, None
    xx, yy, zz, xy, xz, yz = (
        float(numbers(inertia.get(key), (0.0,), name)[0]) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = np.linalg.eigvalsh(matrix)
    is_possible = moments[2] > 0.0 and moments[0] > -0.1 * moments[2]
    return mass, possible(matrix) if is_possible else None


def _size(collision: Element, name: str) -> np.ndarray | None:
    """Return the extent of a box, cylinder or sphere [m], shape (3,); None for a mesh."""
    for shape in collision.iterfind("geometry/*"):
        if shape.tag == "box":
            return numbers(shape.get("size"), (0.1, 0.1, 0.1), name)
        radius = float(numbers(shape.get("radius"), (0.05,), name)[0])
        if shape.tag == "sphere":
            return np.full(3, 2.0 * radius)
        if shape.tag in ("cylinder", "capsule"):
            return np.array([2.0 * radius, 2.0 * radius, float(numbers(shape.get("length"), (0.1,), name)[0])])
    return None


def _add_shapes(lump: Lump, pose: Pose, link: Element, path: Path) -> Iterator[str]:
    """Add the collision shapes of a link; yield the name of every mesh that cannot be used."""
    for collision in link.findall("collision"):
        geometry = collision.find("geometry")
        shape = None if geometry is None else next(iter(geometry), None)
        if shape is None:
            continue
        if shape.tag == "mesh":
            file = find_mesh(shape.get("filename", ""), path)
            if file is None:
                yield Path(shape.get("filename", "")).name
                continue
            scale = {key: value for key, value in shape.attrib.items() if key == "scale"}
            shape = Element("mesh", {**scale, "filename": str(file)})
        lump.shapes.append((_placed(pose, collision.find("origin")), shape))


def find_mesh(name: str, urdf: Path) -> Path | None:
    """Return the file of a mesh; None if it is not found.

    The package of a `package://` name is a folder beside or above the URDF, which can have another name there.
    """
    name = name.removeprefix("file://")
    package, _, inner = name.partition("://")[2].partition("/")
    tries = [urdf.parent / name] if "://" not in name else []
    above = urdf.resolve().parents if inner else ()
    for folder in above:
        tries += [folder / package / inner, folder / inner] if folder.name == package else [folder / package / inner]
    tries += [folder / inner for folder in above]
    return next((one.resolve() for one in tries if one.is_file() and one.suffix.lower() in MESHES), None)


def _write_link(body: Element, lump: Lump, inertia: np.ndarray, factor: float) -> None:
    inertial = SubElement(body, "inertial")
    inertial.append(origin(np.eye(3), lump.center))
    SubElement(inertial, "mass", value=repr(float(factor * lump.mass)))
    names = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    matrix = factor * inertia
    SubElement(inertial, "inertia", {key: repr(float(matrix[place])) for key, place in names.items()})
    for (turn, place), shape in lump.shapes:
        collision = SubElement(body, "collision")
        collision.append(origin(turn, place))
        SubElement(collision, "geometry").append(shape)


def _write_joint(root: Element, name: str, before: str, pose: Pose, axis: np.ndarray) -> None:
    turn, place = pose
    body = SubElement(root, "joint", name=name, type="continuous")
    body.append(origin(turn, place))
    SubElement(body, "parent", link=f"link {before}")
    SubElement(body, "child", link=f"link {name}")
    SubElement(body, "axis", xyz=numbers_text(axis))


def _angles(turn: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw [rad] of an orientation, shape (3,)."""
    pitch = math.asin(min(max(-turn[2, 0], -1.0), 1.0))
    if abs(turn[2, 0]) > 1.0 - 1e-9:  # roll and yaw are around the same axis
        return np.array([math.atan2(-turn[1, 2], turn[1, 1]), pitch, 0.0])
    return np.array([math.atan2(turn[2, 1], turn[2, 2]), pitch, math.atan2(turn[1, 0], turn[0, 0])])


def origin(turn: np.ndarray, place: np.ndarray) -> Element:
    """Return the <origin> of an orientation, shape (3, 3), and a place [m], shape (3,)."""
    return Element("origin", xyz=numbers_text(place), rpy=numbers_text(_angles(turn)))


def numbers_text(values: np.ndarray) -> str:
    """Return numbers with spaces between, exactly."""
    return " ".join(repr(float(value)) for value in values)
