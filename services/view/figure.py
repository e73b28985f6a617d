"""A robot in the 3D scene: a rod for each link of its URDF, a sphere for each joint, and wires."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
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
POSTURES = 40
"""The room that a robot takes is computed from this number of postures."""


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

    def room(self) -> tuple[np.ndarray, float]:
        """Return center [m], shape (3,), and radius [m] of a sphere around most postures within the joints' limits."""
        random, low, high = np.random.default_rng(0), *self._limits()
        places = [self._places(np.zeros(len(self.joints)))]
        places += [self._places(random.uniform(low, high)) for _ in range(POSTURES)]
        lowest, highest = np.min(places, axis=1), np.max(places, axis=1)  # per posture, shape (postures, 3)
        least, most = np.quantile(lowest, 0.3, axis=0), np.quantile(highest, 0.7, axis=0)
        return (least + most) / 2.0, max(float(np.linalg.norm(most - least)) / 2.0, 0.05)

    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the limits of the movable joints, at most a quarter of a turn [rad or m], each of shape (n,)."""
        limits = [self._urdf.joint_map[name].limit for name in self.joints]
        most = [np.pi / 2.0 if self._urdf.joint_map[name].type != "prismatic" else 1.0 for name in self.joints]
        low = [0.0 if limit is None or limit.lower is None else limit.lower for limit in limits]
        high = [0.0 if limit is None or limit.upper is None else limit.upper for limit in limits]
        bound = np.array(most)
        return np.clip(low, -bound, bound), np.clip(high, -bound, bound)

    def _places(self, angles: np.ndarray) -> np.ndarray:
        """Return the ends of all rods in the frame of the root [m], shape (ends, 3)."""
        poses, rods = self.poses(dict(zip(self.joints, angles, strict=True))), self.rods()
        ends = [(poses[link] @ np.append(end, 1.0))[:3] for link in self.links for end in [np.zeros(3), *rods[link]]]
        return np.array(ends)


class Figure:
    """One drawn robot.

    Args:
        site: The page.
        name: Name in the scene.
        body: Kinematics.
        slim: Factor of the radii of rods and joints.
    """

    def __init__(self, site: "viser.ViserServer", name: str, body: Body, slim: float = 1.0) -> None:
        self._poses: dict[str, np.ndarray] = {}
        self._frames: dict[str, Any] = {}
        self._shapes: dict[str, list[Any]] = {}
        self._paints: dict[str, Paint | None] = {}
        rods = body.rods()
        lengths = [float(np.linalg.norm(end)) for ends in rods.values() for end in ends]
        thick = slim * (float(np.mean(lengths)) if lengths else 0.1)
        for link in body.links:
            root = f"/{name}/{link}"
            self._frames[link] = site.scene.add_frame(root, show_axes=False)
            shapes: list[Any] = [site.scene.add_icosphere(f"{root}/joint", radius=KNOB * thick, subdivisions=3)]
            for number, end in enumerate(rods[link]):
                vertices, faces = _rod(end, ROD * thick)
                shapes.append(site.scene.add_mesh_simple(f"{root}/rod{number}", vertices, faces))
            self._shapes[link] = shapes

    def show(self, poses: Mapping[str, np.ndarray], paints: Mapping[str, Paint | None]) -> None:
        """Move links to poses, each of shape (4, 4), and paint them; a link without a paint is not visible."""
        from viser.transforms import SO3

        for link, pose in poses.items():
            before = self._poses.get(link)
            if before is None or not np.allclose(pose, before, atol=1e-5):
                self._poses[link] = pose.copy()
                self._frames[link].wxyz = SO3.from_matrix(pose[:3, :3]).wxyz
                self._frames[link].position = pose[:3, 3]
        for link, paint in paints.items():
            if link in self._paints and paint == self._paints[link]:
                continue
            self._paints[link] = paint
            self._frames[link].visible = paint is not None
            if paint is None:
                continue
            for shape in self._shapes[link]:
                shape.color, shape.opacity = paint.color, paint.opacity


class Wires:
    """Wires of a muscle-driven robot, straight between their points.

    Args:
        site: The page.
        routes: Name of a wire -> its points: link, and place in its frame [m].
        thick: Thickness of a wire [m].
    """

    def __init__(
        self, site: "viser.ViserServer", routes: Mapping[str, Sequence[tuple[str, float, float, float]]], thick: float
    ) -> None:
        self.names = tuple(routes)
        """Names of the wires."""
        self._stretches = [(index, *ends) for index, route in enumerate(routes.values()) for ends in pairwise(route)]
        self._wire_of = np.array([index for index, *_ in self._stretches])
        shape = (len(self._stretches), 2, 3)
        self._lines = site.scene.add_line_segments(
            "/wires", np.zeros(shape, np.float32), np.zeros(shape, np.uint8), thickness=thick, visible=False
        )

    def show(self, poses: Mapping[str, np.ndarray], colors: np.ndarray) -> None:
        """Draw the wires of a posture.

        Args:
            poses: Link -> its frame, shape (4, 4).
            colors: Color of every wire (0 to 255), shape (wires, 3).
        """
        points = [
            [(poses[link] @ np.array([*place, 1.0]))[:3] for link, *place in (start, end)]
            for _, start, end in self._stretches
        ]
        self._lines.points = np.array(points, np.float32)
        self._lines.colors = np.repeat(colors[self._wire_of, None], 2, axis=1).round().astype(np.uint8)
        self._lines.visible = True


def _rod(end: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a rod from the origin to a point [m]."""
    import trimesh

    mesh = trimesh.creation.cylinder(radius=radius, segment=np.array([np.zeros(3), end]), sections=18)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
