"""The robot in 3D, as the model knows it; where sensors are silent or distrusted, a ghost shows what they measured."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from services.errors import ServiceError
from services.view.figure import Body, Figure, Paint, Wires
from services.watch.signal_rows import Kind, SignalRow
from services.watch.snapshot import RobotSnapshot, fresh

if TYPE_CHECKING:
    import viser

BLUE, AMBER = (92, 160, 230), (255, 176, 74)
GREY = Paint((105, 112, 124))
UNKNOWN = Paint((105, 112, 124), 0.35)
"""Links with this paint have an unknown position and stay at the last one."""
GHOST = Paint((255, 255, 255), 0.22)
"""The ghost has this paint."""
APART = 2e-3
"""The ghost of a link is drawn if a joint below it differs by more than this [rad]."""
POINT = ("x", "y", "z")
"""A signal in m with these elements is shown as a point."""
VIEW = np.array([1.0, -0.6, 0.3]) / np.linalg.norm([1.0, -0.6, 0.3])
"""The camera looks at the robot from this direction."""
MOVED = 0.01
"""A camera this far from where it was put, as a share of the robot's radius, was moved by the person."""
PLACES = 8
"""This many places of the camera are remembered: while a window is resized reports are that many behind."""
MARGIN = 1.1
"""The picture is this factor larger than the robot."""
PHONE, TOP = 0.75, 0.44
"""In a window with a smaller ratio of width to height, viser's panel covers all but this upper share."""
FULL_TENSION = 100.0
"""Wires without a limit have their last color at this tension [N]."""
GAMMA = 2.2
"""viser takes the colors of lines as linear, those of all else as sRGB; this exponent converts them."""
SLACK, HALF, FULL = np.array([20, 70, 230]), np.array([255, 160, 0]), np.array([255, 20, 0])


@dataclass(frozen=True, slots=True)
class Looks:
    """Look of a robot.

    Attributes:
        urdf: URDF of the robot; None if there is none.
        wires: Element of the tension signal -> points of its wire: link, and place in its frame [m].
    """

    urdf: Path | None = None
    wires: Mapping[str, Sequence[tuple[str, float, float, float]]] | None = None


class Scene:
    """The drawn robot; without a URDF only points and a label.

    Args:
        site: The page.
        looks: Look of the robot.

    Raises:
        ServiceError: The URDF cannot be read, or a wire is on a link that it does not have.
    """

    def __init__(self, site: "viser.ViserServer", looks: Looks) -> None:
        self._site = site
        self._angles: dict[str, dict[str, float]] = {"known": {}, "ghost": {}}
        self._kinds: dict[str, Kind] = {}
        self._sensed: dict[str, float] = {}
        self._places: dict[str, float] = {}
        """Coordinates of points, as measured last [m]."""
        self._points: dict[tuple[str, str], Any] = {}
        self._figures: dict[str, Figure] = {}
        self._wires: Wires | None = None
        body = self._body = None if looks.urdf is None else Body(looks.urdf)
        self._joints = () if body is None else body.joints
        self._links = {} if body is None else {link: body.carried_by(link) for link in body.links}
        self._center: np.ndarray
        self._center, self._radius = (np.zeros(3), 0.5) if body is None else body.room()
        if body is not None:
            slim = 0.5 if looks.wires else 1.0  # or the wires would be inside
            self._figures = {name: Figure(site, name, body, slim) for name in self._angles}
            if looks.wires:
                strangers = {link for route in looks.wires.values() for link, *_ in route} - set(body.links)
                if strangers:
                    known = ", ".join(body.links)
                    raise ServiceError(f"A wire is on link '{min(strangers)}', which the URDF lacks. Links: {known}.")
                self._wires = Wires(site, looks.wires, 0.012 * self._radius)
        self._furnish()

    def follow(self, snapshot: RobotSnapshot, rows: Sequence[SignalRow]) -> None:
        """Keep the present values, and what the sensors said last; also call it while no browser is open."""
        self._kinds, self._sensed = {}, _sensed(snapshot, rows)
        for row in rows:
            if row.unit == "m" and row.kind is Kind.MEASURED:
                self._places[row.name] = row.value
            if row.element not in self._joints or row.unit != "rad" or row.element in self._kinds:
                continue
            self._kinds[row.element] = row.kind
            if np.isfinite(row.value):
                self._angles["known"][row.element] = row.value
            value = self._sensed.get(row.name, row.value if row.kind is Kind.MEASURED else math.nan)
            if np.isfinite(value):
                self._angles["ghost"][row.element] = value

    def show(self, snapshot: RobotSnapshot, rows: Sequence[SignalRow]) -> None:
        """Move the robot and its ghost to the values kept; a link's color shows the origin of all its joints."""
        with self._site.atomic():
            if self._body is not None:
                self._show_figures(self._body, self._kinds, snapshot, rows)
            self._show_points(rows)

    def fit(self, aspect: float, field: float, top: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return position and target of a camera [m], each of shape (3,), that sees the whole robot.

        Args:
            aspect: Width of the picture divided by its height.
            field: Vertical field of view [rad].
            top: Upper share of the picture that no panel covers.
        """
        tall = math.tan(field / 2.0)
        half = math.atan(min(top, aspect) * tall)
        distance = MARGIN * self._radius / math.sin(half)
        above = np.array([0.0, 0.0, 1.0]) - VIEW[2] * VIEW
        shift = (1.0 - top) * tall * distance * above / np.linalg.norm(above)
        return self._center + distance * VIEW - shift, self._center - shift

    def _show_figures(
        self, body: Body, kinds: Mapping[str, Kind], snapshot: RobotSnapshot, rows: Sequence[SignalRow]
    ) -> None:
        known, ghost = self._angles["known"], self._angles["ghost"]
        apart = {
            joint
            for joint, kind in kinds.items()
            if kind is Kind.ESTIMATED and joint in ghost and abs(known[joint] - ghost[joint]) > APART
        }
        paints = {link: self._paint(link, kinds) for link in self._links}
        poses = body.poses(known)
        self._figures["known"].show(poses, paints)
        ghosts = {link: GHOST if apart & set(carriers) else None for link, carriers in self._links.items()}
        self._figures["ghost"].show(body.poses(ghost) if apart else {}, ghosts)
        if self._wires is not None:
            self._wires.show(poses, wire_colors(snapshot, rows, self._wires.names))

    def _paint(self, link: str, kinds: Mapping[str, Kind]) -> Paint:
        carriers = self._links[link]
        below = {kinds.get(joint, Kind.MASKED) for joint in carriers}
        if not carriers:
            return GREY
        if below == {Kind.MEASURED}:
            return Paint(BLUE)
        return Paint(AMBER) if below <= {Kind.MEASURED, Kind.ESTIMATED} else UNKNOWN

    def _show_points(self, rows: Sequence[SignalRow]) -> None:
        for signal in dict.fromkeys(row.signal for row in rows if row.unit == "m"):
            three = {row.element: row for row in rows if row.signal == signal}
            if tuple(three) != POINT:
                continue
            is_estimated = Kind.ESTIMATED in {row.kind for row in three.values()}
            place = np.array([three[axis].value for axis in POINT])
            self._place("known", signal, place, Paint(AMBER if is_estimated else BLUE))
            names = [three[axis].name for axis in POINT]
            was = np.array([self._sensed.get(name, self._places.get(name, math.nan)) for name in names])
            self._place("ghost", signal, was if is_estimated else np.full(3, np.nan), GHOST)

    def _place(self, name: str, signal: str, place: np.ndarray, paint: Paint) -> None:
        is_known = bool(np.isfinite(place).all())
        handle = self._points.get((name, signal))
        if handle is None:
            if not is_known:
                return
            handle = self._site.scene.add_icosphere(f"/{name}/{signal}", radius=0.03 * self._radius)
            self._points[name, signal] = handle
        if is_known:
            handle.position, handle.color, handle.opacity = place, paint.color, paint.opacity
        handle.visible = is_known

    def _furnish(self) -> None:
        scene, size = self._site.scene, self._radius
        scene.set_up_direction("+z")
        scene.configure_default_lights(enabled=True, cast_shadow=False)  # shadows cost a second screen its frames
        x, y, z = self._center
        low = z - 1.05 * size if self._body is not None else 0.0
        scene.add_grid(
            "/floor", width=6 * size, height=6 * size, cell_size=size / 5, section_size=size, position=(x, y, low),
            cell_color=(58, 64, 74), section_color=(80, 88, 100),
        )  # fmt: skip
        if self._body is None:
            scene.add_label("/nothing", "no URDF: give one with --urdf", position=(0.0, 0.0, 0.0))
            return
        camera = self._site.initial_camera
        camera.position, camera.look_at = self.fit(0.9, camera.fov)
        self._site.on_client_connect(self._fit_client)

    def _fit_client(self, client: "viser.ClientHandle") -> None:
        """Fit the camera to a new browser window and to each new shape of its picture, until the person moves it.

        A browser first reports the shape of the whole window, and later that of the picture beside the panels.
        """
        camera = client.camera
        shape, top = 0.0, 0.0
        places = deque([camera.position.copy()], PLACES)
        """Where the camera was at first and was put since: a report from there may have been on its way meanwhile, and
        one from elsewhere is of a person who moved it."""

        def fit(_: "viser.CameraHandle") -> None:
            nonlocal shape, top
            if not (camera.image_width and camera.image_height):
                return  # a window that is minimised
            was_put = min(np.linalg.norm(camera.position - place) for place in places) < MOVED * self._radius
            if camera.aspect == shape or not was_put:
                return
            top = top or (TOP if camera.aspect < PHONE else 1.0)
            shape = camera.aspect
            place, target = self.fit(shape, camera.fov, top)
            places.append(place)
            with client.atomic():
                camera.position, camera.look_at = place, target

        fit(camera)
        camera.on_update(fit)


def _sensed(snapshot: RobotSnapshot, rows: Sequence[SignalRow]) -> dict[str, float]:
    """Return element -> value that its sensor sends, of elements that are distrusted [its unit]."""
    sample, indices = fresh(snapshot.sample), dict[str, int]()
    sensed = {}
    for row in rows:
        index = indices[row.signal] = indices.get(row.signal, -1) + 1
        if row.distrust and sample is not None and row.signal in sample.values:
            values, valid = sample.values[row.signal], sample.valid[row.signal]
            if index < len(values) and valid[index]:
                sensed[row.name] = float(values[index])
    return sensed


def wire_colors(snapshot: RobotSnapshot, rows: Sequence[SignalRow], names: Sequence[str]) -> np.ndarray:
    """Return the color of every wire (red, green, blue; 0 to 255), shape (wires, 3), by its tension.

    The scale ends at the robot file's `soft_high`, by the square root, because a resting muscle has a small tension.
    """
    tensions = {row.element: row for row in rows if row.unit == "N"}
    colors = np.empty((len(names), 3))
    for index, name in enumerate(names):
        row = tensions.get(name)
        if row is None or row.kind is Kind.OLD or not math.isfinite(row.value):
            colors[index] = GREY.color
            continue
        limit = snapshot.hal.get("limits", {}).get(row.signal, {}).get("soft_high")
        full = float(limit) if isinstance(limit, int | float) and limit > 0 else FULL_TENSION
        share = math.sqrt(min(max(row.value, 0.0) / full, 1.0))
        low, high, part = (SLACK, HALF, 2.0 * share) if share < 0.5 else (HALF, FULL, 2.0 * share - 1.0)
        colors[index] = low + part * (high - low)
    return 255.0 * (colors / 255.0) ** GAMMA
