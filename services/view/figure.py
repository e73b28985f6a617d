"""A robot in the 3D scene: a rod for each link of its URDF and a sphere for each joint."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from services.errors import ServiceError

if TYPE_CHECKING:
    import viser

ROD, KNOB = 0.09, 0.13
"""Rods and joints have these radii, as a share of the mean length of the robot's links."""
SHORT = 1e-3
"""Links shorter than this [m] have no rod."""


@dataclass(frozen=True, slots=True)
class Paint:
    """Color (red, green, blue; 0 to 255) and opacity; None for opaque."""

    color: tuple[int, int, int]
    opacity: float | None = None


class Body:
    """The kinematics of a URDF.

    Raises:
        ServiceError: The file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        import yourdfpy

        try:
            self._urdf = yourdfpy.URDF.load(str(path), build_scene_graph=True, load_meshes=False)
        except Exception as error:  # yourdfpy and lxml document no exceptions
            raise ServiceError(f"The URDF '{path}' cannot be read: {' '.join(str(error).split())}.") from None
        self.joints: tuple[str, ...] = tuple(self._urdf.actuated_joint_names)
        self.links: tuple[str, ...] = tuple(self._urdf.link_map)
        self._mover = {joint.child: joint.name for joint in self._urdf.joint_map.values()}
        self._parent = {joint.child: joint.parent for joint in self._urdf.joint_map.values()}

    def poses(self, angles: Mapping[str, float]) -> dict[str, np.ndarray]:
        """Return link -> its frame in the frame of the root, shape (4, 4); joints without an angle are at zero."""
        self._urdf.update_cfg({name: float(angles.get(name, 0.0)) for name in self.joints})
        return {link: np.asarray(self._urdf.get_transform(link)) for link in self.links}

    def carried_by(self, link: str) -> tuple[str, ...]:
        """Return the movable joints between the root and a link."""
        joints = []
        while link in self._mover:
            if self._mover[link] in self.joints:
                joints.append(self._mover[link])
            link = self._parent[link]
        return tuple(joints)

    def rods(self) -> dict[str, list[np.ndarray]]:
        """Return link -> ends of its rods in its frame [m].

        A rod ends at the next joint. A last link ends as far behind its center of mass as its joint is before it.
        """
        rods: dict[str, list[np.ndarray]] = {link: [] for link in self.links}
        for joint in self._urdf.joint_map.values():
            origin = np.eye(4) if joint.origin is None else np.asarray(joint.origin)
            rods[joint.parent].append(origin[:3, 3])
        for link, ends in rods.items():
            inertial = self._urdf.link_map[link].inertial
            if not ends and link in self._mover and inertial is not None and inertial.origin is not None:
                ends.append(2.0 * np.asarray(inertial.origin)[:3, 3])
        return {link: [end for end in ends if np.linalg.norm(end) > SHORT] for link, ends in rods.items()}

    def reach(self) -> float:
        """Return the largest distance of a rod's end from the root in the zero posture [m]."""
        rods = self.rods()
        ends = [
            (pose @ np.append(end, 1.0))[:3]
            for link, pose in self.poses({}).items()
            for end in [np.zeros(3), *rods[link]]
        ]
        return float(np.max(np.linalg.norm(ends, axis=1)))


class Figure:
    """One drawn robot.

    Args:
        site: The page.
        name: Name in the scene.
        body: Kinematics.
        at: Position of the root [m], shape (3,).
    """

    def __init__(self, site: "viser.ViserServer", name: str, body: Body, at: np.ndarray) -> None:
        self._body, self._at = body, at
        self._poses: dict[str, np.ndarray] = {}
        self._frames: dict[str, Any] = {}
        self._shapes: dict[str, list[Any]] = {}
        self._paints: dict[str, Paint] = {}
        rods = body.rods()
        lengths = [float(np.linalg.norm(end)) for ends in rods.values() for end in ends]
        thick = float(np.mean(lengths)) if lengths else 0.1
        for link in body.links:
            root = f"/{name}/{link}"
            self._frames[link] = site.scene.add_frame(root, show_axes=False)
            shapes: list[Any] = [site.scene.add_icosphere(f"{root}/joint", radius=KNOB * thick, subdivisions=3)]
            for number, end in enumerate(rods[link]):
                vertices, faces = _rod(end, ROD * thick)
                shapes.append(site.scene.add_mesh_simple(f"{root}/rod{number}", vertices, faces))
            self._shapes[link] = shapes

    def show(self, angles: Mapping[str, float], paints: Mapping[str, Paint]) -> None:
        """Move to joint angles [rad] and paint every link."""
        from viser.transforms import SO3

        for link, pose in self._body.poses(angles).items():
            before = self._poses.get(link)
            if before is None or not np.allclose(pose, before, atol=1e-5):
                self._poses[link] = pose.copy()
                self._frames[link].wxyz = SO3.from_matrix(pose[:3, :3]).wxyz
                self._frames[link].position = pose[:3, 3] + self._at
            paint = paints[link]
            if paint != self._paints.get(link):
                self._paints[link] = paint
                for shape in self._shapes[link]:
                    shape.color, shape.opacity = paint.color, paint.opacity


def _rod(end: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a rod from the origin to a point [m]."""
    import trimesh

    mesh = trimesh.creation.cylinder(radius=radius, segment=np.array([np.zeros(3), end]), sections=18)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
