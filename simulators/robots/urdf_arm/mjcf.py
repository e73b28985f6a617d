"""An MJCF file of MuJoCo as a URDF: bodies, joints, limits, torques, masses, contact shapes, sites and cameras.

MuJoCo reads the file, so includes, defaults, meshes and attached models are as MuJoCo has them.
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from hal.errors import ConfigError
from simulators.chain import GRAVITY
from simulators.robots.urdf_arm.body_file import numbers_text, origin
from simulators.robots.urdf_arm.choice import element_name

if TYPE_CHECKING:
    import mujoco

FREE, BALL, SLIDE, HINGE = range(4)
"""Kinds of joints of MuJoCo (mjtJoint)."""
SPHERE, CAPSULE, CYLINDER, BOX, MESH = 2, 3, 5, 6, 7
"""Shapes of MuJoCo (mjtGeom) that a URDF has, a capsule as a cylinder and two spheres."""
OTHERS = {0: "plane (there is a floor)", 1: "height field", 4: "ellipsoid", 8: "signed distance field"}
"""Shapes of MuJoCo that a URDF lacks."""
JOINTS, TENDON = (0, 1), 3
"""Kinds of what an actuator pulls (mjtTrn): a joint, a joint in the frame of its parent; a tendon."""
CONNECT, WELD, COUPLED = 0, 1, 2
"""Kinds of equality constraints (mjtEq)."""


@dataclass(frozen=True, slots=True)
class Converted:
    """A URDF made of an MJCF file.

    Attributes:
        root: The URDF; its meshes have names without a folder.
        meshes: Name of a file -> binary STL.
        notes: Sentences on what a URDF or the simulation cannot have.
    """

    root: Element
    meshes: Mapping[str, bytes]
    notes: tuple[str, ...]

    def text(self, folder: str) -> str:
        """Return the URDF as text; its meshes are in `folder`."""
        root = ElementTree.fromstring(ElementTree.tostring(self.root))
        for mesh in root.iter("mesh"):
            mesh.set("filename", f"{folder}/{mesh.get('filename')}")
        ElementTree.indent(root)
        return ElementTree.tostring(root, encoding="unicode") + "\n"


def is_mjcf(path: Path) -> bool:
    """Whether a file is XML whose root is <mujoco>."""
    try:
        return ElementTree.parse(path).getroot().tag == "mujoco"
    except (OSError, ValueError, ElementTree.ParseError):
        return False


def convert(path: Path) -> Converted:
    """Return the URDF of an MJCF file.

    Raises:
        ConfigError: MuJoCo cannot read the file.
        ModuleNotFoundError: MuJoCo is not installed.
    """
    import mujoco

    try:
        with warnings.catch_warnings(action="ignore"):  # MuJoCo warns of attributes that a later version will not have
            spec = mujoco.MjSpec.from_file(str(path))
            model = spec.compile()
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise ConfigError(f"MuJoCo cannot read '{path}': {reason}. Are its meshes and includes beside it?") from None
    name = "" if spec.modelname.lower() in ("", "mujoco model") else spec.modelname
    return _Writer(model, name or path.stem).convert()


class _Writer:
    """Writer of the links and joints of one model."""

    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self._model = model
        self._root = Element("robot", name=name)
        self._meshes: dict[str, bytes] = {}
        self._taken: set[str] = set()
        self._left_out: dict[str, list[str]] = {}
        self._effort = _efforts(model)
        self._mimics = _couplings(model)
        self._links: dict[int, str] = {0: self._own("world")}

    def convert(self) -> Converted:
        model = self._model
        kept = [body for body in range(1, model.nbody) if self._is_kept(body)]
        self._write_body(0)
        for body in kept:
            self._links[body] = self._own(model.body(body).name or f"body_{body}")
        for body in kept:
            self._write_body(body)
            self._write_joints(body)
        cameras = [self._write_frame("camera", index) for index in range(model.ncam) if model.cam_bodyid[index] in kept]
        for index in range(model.nsite):
            if int(model.site_bodyid[index]) in self._links and model.site(index).name:
                self._write_frame("site", index)
        return Converted(self._root, self._meshes, tuple(self._notes(cameras)))

    def _is_kept(self, body: int) -> bool:
        """Whether a body stands still or belongs to a robot: loose objects of a scene do not."""
        model = self._model
        root = int(model.body_rootid[body])
        own = [one for one in range(model.nbody) if model.body_rootid[one] == root]
        joints = [joint for joint in range(model.njnt) if int(model.jnt_bodyid[joint]) in own]
        is_loose = joints and not any(self._is_driven(joint) for joint in joints)
        if is_loose or model.body_mocapid[root] >= 0:
            self._leave_out("Left out, because no motor moves it", model.body(root).name or f"body {root}")
            return False
        return True

    def _is_driven(self, joint: int) -> bool:
        """Whether a joint turns or slides and has a motor, or no joint of the file has one."""
        return int(self._model.jnt_type[joint]) in (SLIDE, HINGE) and (not self._effort or joint in self._effort)

    def _leave_out(self, why: str, name: str) -> None:
        names = self._left_out.setdefault(why, [])
        if name not in names:
            names.append(name)

    def _own(self, name: str) -> str:
        """Return a name of a link that no other link has."""
        name = name.replace("/", "_")
        while name in self._taken:
            name += "_"
        self._taken.add(name)
        return name

    def _write_body(self, body: int) -> None:
        model = self._model
        link = SubElement(self._root, "link", name=self._links[body])
        if model.body_mass[body] > 0.0:
            inertial = SubElement(link, "inertial")
            inertial.append(origin(_turn(model.body_iquat[body]), model.body_ipos[body]))
            SubElement(inertial, "mass", value=repr(float(model.body_mass[body])))
            moments = dict(zip(("ixx", "iyy", "izz"), map(float, model.body_inertia[body]), strict=True))
            values = {"ixy": 0.0, "ixz": 0.0, "iyz": 0.0} | moments
            SubElement(inertial, "inertia", {key: repr(value) for key, value in values.items()})
        for geom in range(model.ngeom):
            if model.geom_bodyid[geom] == body and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
                self._write_shape(link, geom)

    def _write_shape(self, link: Element, geom: int) -> None:
        model, kind = self._model, int(self._model.geom_type[geom])
        turn, place, size = _turn(model.geom_quat[geom]), model.geom_pos[geom], model.geom_size[geom]
        if kind in OTHERS:
            self._leave_out("No contact of shapes that a URDF lacks", OTHERS[kind])
            return
        shapes: list[tuple[Element, float]] = []
        if kind == BOX:
            shapes.append((Element("box", size=numbers_text(2.0 * size)), 0.0))
        elif kind == MESH:
            shapes.append((Element("mesh", filename=self._mesh(int(model.geom_dataid[geom]))), 0.0))
        radius = repr(float(size[0]))
        if kind in (CYLINDER, CAPSULE):
            shapes.append((Element("cylinder", radius=radius, length=repr(2.0 * float(size[1]))), 0.0))
        if kind in (SPHERE, CAPSULE):
            ends = (-float(size[1]), float(size[1])) if kind == CAPSULE else (0.0,)
            shapes += [(Element("sphere", radius=radius), end) for end in ends]
        for shape, along in shapes:
            collision = SubElement(link, "collision")
            collision.append(origin(turn, place + along * turn[:, 2]))
            SubElement(collision, "geometry").append(shape)

    def _mesh(self, mesh: int) -> str:
        model = self._model
        name = f"{element_name(model.mesh(mesh).name)}_{mesh}.stl"
        if name not in self._meshes:
            corners = model.mesh_vert[int(model.mesh_vertadr[mesh]) :][_faces(model, mesh)]
            self._meshes[name] = _stl(corners)
        return name

    def _write_joints(self, body: int) -> None:
        """Write the joints between a body and its parent: in MuJoCo several may move one body, each around a point."""
        model = self._model
        before, turn, place = self._links[int(model.body_parentid[body])], *_pose(model, body)
        own = range(int(model.body_jntadr[body]), int(model.body_jntadr[body]) + int(model.body_jntnum[body]))
        moving = [joint for joint in own if self._moves(joint)]
        for joint in moving:
            anchor = np.array(model.jnt_pos[joint])
            is_last = joint == moving[-1] and not anchor.any()
            behind = self._links[body] if is_last else self._own(f"{self._links[body]} {self._named(joint)}")
            if not is_last:
                SubElement(self._root, "link", name=behind)
            self._joint(joint, before, behind).append(origin(turn, place + turn @ anchor))
            before, turn, place = behind, np.eye(3), -anchor
        if before != self._links[body]:
            self._fix(before, self._links[body], turn, place)

    def _moves(self, joint: int) -> bool:
        """Whether a joint is one in the URDF; the others are held."""
        kind = int(self._model.jnt_type[joint])
        if kind not in (SLIDE, HINGE):
            self._leave_out("Held still, because they are free or ball joints", self._named(joint))
        elif not self._is_driven(joint) and joint not in self._mimics:
            self._leave_out("Held still, because they have no motor of their own", self._named(joint))
        else:
            return True
        return False

    def _named(self, joint: int) -> str:
        return element_name(self._model.joint(joint).name or f"joint_{joint}")

    def _fix(self, parent: str, child: str, turn: np.ndarray, place: np.ndarray) -> None:
        fixing = SubElement(self._root, "joint", name=f"fixing of {child}", type="fixed")
        fixing.append(origin(turn, place))
        SubElement(fixing, "parent", link=parent)
        SubElement(fixing, "child", link=child)

    def _joint(self, joint: int, before: str, behind: str) -> Element:
        model, name = self._model, self._named(joint)
        is_limited, turns = bool(model.jnt_limited[joint]), int(model.jnt_type[joint]) == HINGE
        kind = "prismatic" if not turns else "revolute" if is_limited else "continuous"
        element = SubElement(self._root, "joint", name=name, type=kind)
        SubElement(element, "parent", link=before)
        SubElement(element, "child", link=behind)
        SubElement(element, "axis", xyz=numbers_text(model.jnt_axis[joint]))
        reference = float(model.qpos0[int(model.jnt_qposadr[joint])])
        if reference:
            self._leave_out("Zero is moved to the posture in which the file draws it", f"{name} by {reference:.4g}")
        limit = SubElement(element, "limit", effort=repr(self._effort.get(joint, 0.0)), velocity="0")
        if is_limited:
            low, high = (float(end) - reference for end in model.jnt_range[joint])
            limit.attrib.update({"lower": repr(low), "upper": repr(high)})
        if joint in self._mimics:
            other, factor, shift = self._mimics[joint]
            SubElement(element, "mimic", joint=self._named(other), multiplier=repr(factor), offset=repr(shift))
        return element

    def _write_frame(self, kind: str, index: int) -> str:
        """Write a site or a camera as a link that is fixed to its body; return its name."""
        model = self._model
        part = model.site(index) if kind == "site" else model.camera(index)
        body = int((model.site_bodyid if kind == "site" else model.cam_bodyid)[index])
        name = part.name or f"{kind}_{index}"
        link = self._own(name if kind == "site" or "camera" in name.lower() else f"{name}_camera")
        SubElement(self._root, "link", name=link)
        self._fix(self._links[body], link, _turn(part.quat), np.array(part.pos))
        return link

    def _notes(self, cameras: list[str]) -> Iterator[str]:
        model = self._model
        yield "The URDF was made by MuJoCo from the MJCF file; edit that, and make both again."
        for why, names in self._left_out.items():
            more = f" and {len(names) - 6} more" if len(names) > 6 else ""
            yield f"{why}: {', '.join(names[:6])}{more}."
        if cameras:
            yield (
                f"Cameras of the file are links without a picture: {', '.join(cameras)}. The robot file's camera "
                "stands still and measures the place of the tip."
            )
        if not self._effort:
            yield "The file has no motor at a joint, so every joint that turns has one, with a torque from the inertia."
        if not np.allclose(model.opt.gravity, (0.0, 0.0, -9.81), atol=0.02):
            yield f"Gravity is {GRAVITY:.2f} m/s2 downwards, not {numbers_text(model.opt.gravity)} as in the file."
        lost = {
            "armature, damping and friction of joints": bool(
                model.dof_armature.any() or model.dof_damping.any() or model.dof_frictionloss.any()
            ),
            "tendons": model.ntendon > 0,
            "loops and welds": any(int(kind) in (CONNECT, WELD) for kind in model.eq_type),
            "gains of actuators": model.nu > 0,
        }
        parts = [part for part, is_lost in lost.items() if is_lost]
        if parts:
            yield f"Not simulated: {', '.join(parts)}."


def _efforts(model: mujoco.MjModel) -> dict[int, float]:
    """Return joint -> largest torque or force of its actuators [N m or N], 0 if not stated; others have no motor."""
    efforts: dict[int, float] = {}
    for actuator in range(model.nu):
        if int(model.actuator_trntype[actuator]) not in JOINTS:
            continue
        joint = int(model.actuator_trnid[actuator][0])
        most = 0.0
        if model.actuator_forcelimited[actuator]:
            most = float(np.abs(model.actuator_forcerange[actuator]).max())
        elif model.actuator_ctrllimited[actuator] and not int(model.actuator_biastype[actuator]):
            gain = float(model.actuator_gainprm[actuator][0])
            most = abs(gain) * float(np.abs(model.actuator_ctrlrange[actuator]).max())
        most *= abs(float(model.actuator_gear[actuator][0]))
        efforts[joint] = max(efforts.get(joint, 0.0), most)
    for joint, most in efforts.items():
        if model.jnt_actfrclimited[joint]:
            own = float(np.abs(model.jnt_actfrcrange[joint]).max())
            efforts[joint] = min(most, own) if most else own
    return efforts


def _couplings(model: mujoco.MjModel) -> dict[int, tuple[int, float, float]]:
    """Return joint -> joint that it follows, factor and offset, of constraints that are active in the file."""
    return {
        int(model.eq_obj1id[index]): (
            int(model.eq_obj2id[index]),
            float(model.eq_data[index][1]),
            float(model.eq_data[index][0]),
        )
        for index in range(model.neq)
        if int(model.eq_type[index]) == COUPLED and model.eq_active0[index] and model.eq_obj2id[index] >= 0
    }


def _pose(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Return orientation, shape (3, 3), and place [m], shape (3,), of a body in its parent as the file draws it."""
    return _turn(model.body_quat[body]), np.array(model.body_pos[body])


def _turn(quaternion: np.ndarray) -> np.ndarray:
    """Return the orientation of a unit quaternion w, x, y, z, shape (3, 3)."""
    w, x, y, z = (float(value) for value in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _faces(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    """Return the vertices of each face of a mesh, or of its convex hull if MuJoCo made one, shape (k, 3)."""
    start = int(model.mesh_graphadr[mesh])
    if start < 0:
        first = int(model.mesh_faceadr[mesh])
        return np.array(model.mesh_face[first : first + int(model.mesh_facenum[mesh])])
    vertices, faces = (int(number) for number in model.mesh_graph[start : start + 2])
    first = start + 2 + 3 * vertices + 3 * faces  # behind two lists of vertices and one of edges
    return np.array(model.mesh_graph[first : first + 3 * faces]).reshape(-1, 3)


def _stl(corners: np.ndarray) -> bytes:
    """Return binary STL of triangles whose corners [m] have shape (k, 3, 3)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    kind = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")]
    faces = np.zeros(len(corners), dtype=kind)
    faces["normal"], faces["corners"] = normals, corners
    return bytes(80) + np.uint32(len(corners)).tobytes() + faces.tobytes()
