"""The robot drawn twice: as measured, and with the model's estimates."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from services.view.figure import Body, Figure, Paint
from services.watch.signal_rows import Kind, SignalRow
from services.watch.snapshot import RobotSnapshot

if TYPE_CHECKING:
    import viser

BLUE, AMBER, PALE = (92, 160, 230), (255, 176, 74), (196, 204, 216)
GREY = Paint((105, 112, 124))
GHOST = Paint((105, 112, 124), 0.35)
"""Links with this paint have an unknown position and stay at the last one."""
POINT = ("x", "y", "z")
"""A signal in m with these elements is shown as a point."""


class Scene:
    """Both drawn robots; without a URDF only points and a label.

    Args:
        site: The page.
        urdf: URDF of the robot; None if there is none.

    Raises:
        ServiceError: The URDF cannot be read.
    """

    def __init__(self, site: "viser.ViserServer", urdf: Path | None) -> None:
        self._site = site
        self._figures: dict[str, Figure] = {}
        self._angles: dict[str, dict[str, float]] = {"measured": {}, "estimated": {}}
        self._points: dict[tuple[str, str], Any] = {}
        body = None if urdf is None else Body(urdf)
        self._joints = () if body is None else body.joints
        self._links = {} if body is None else {link: body.carried_by(link) for link in body.links}
        size = 0.5 if body is None else body.reach()
        self._at = {"measured": np.array([0.0, -0.5 * size, 0.0]), "estimated": np.array([0.0, 0.5 * size, 0.0])}
        if body is not None:
            self._figures = {name: Figure(site, name, body, at) for name, at in self._at.items()}
        self._furnish(size, body is not None)

    def show(self, snapshot: RobotSnapshot, rows: Sequence[SignalRow]) -> None:
        """Move both robots to the present values; the color of a link shows the origin of all joints that carry it."""
        kinds: dict[str, Kind] = {}
        for row in rows:
            if row.element not in self._joints or row.unit != "rad" or row.element in kinds:
                continue
            kinds[row.element] = row.kind
            if np.isfinite(row.value):
                self._angles["estimated"][row.element] = row.value
                if row.kind is not Kind.ESTIMATED:
                    self._angles["measured"][row.element] = row.value
        with self._site.atomic():
            for name, figure in self._figures.items():
                figure.show(self._angles[name], {link: self._paint(name, link, kinds) for link in self._links})
            self._show_points(rows)

    def _paint(self, name: str, link: str, kinds: Mapping[str, Kind]) -> Paint:
        carriers = self._links[link]
        below = {kinds.get(joint, Kind.MASKED) for joint in carriers}
        if not carriers:
            return GREY
        if below == {Kind.MEASURED}:
            return Paint(BLUE if name == "measured" else PALE)
        return Paint(AMBER) if name == "estimated" and below <= {Kind.MEASURED, Kind.ESTIMATED} else GHOST

    def _show_points(self, rows: Sequence[SignalRow]) -> None:
        for signal in dict.fromkeys(row.signal for row in rows if row.unit == "m"):
            three = {row.element: row for row in rows if row.signal == signal}
            if tuple(three) != POINT:
                continue
            for name, at in self._at.items():
                kinds = {row.kind for row in three.values()}
                place = np.array([three[axis].value for axis in POINT])
                is_estimated = Kind.ESTIMATED in kinds
                is_known = np.isfinite(place).all() and not (is_estimated and name == "measured")
                handle = self._points.get((name, signal))
                if handle is None:
                    handle = self._site.scene.add_icosphere(f"/{name}/{signal}", radius=0.02, color=BLUE)
                    self._points[name, signal] = handle
                if is_known:
                    handle.position = place + at
                    handle.color = AMBER if is_estimated else BLUE if name == "measured" else PALE
                handle.visible = bool(is_known)

    def _furnish(self, size: float, has_robot: bool) -> None:
        scene = self._site.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(enabled=True, cast_shadow=False)  # shadows cost a second screen its frames
        low = -1.05 * size if has_robot else 0.0
        scene.add_grid(
            "/floor", width=6 * size, height=6 * size, cell_size=size / 5, section_size=size, position=(0.0, 0.0, low),
            cell_color=(58, 64, 74), section_color=(80, 88, 100),
        )  # fmt: skip
        if not has_robot:
            scene.add_label("/nothing", "no URDF: give one with --urdf", position=(0.0, 0.0, 0.0))
            return
        for name, at in self._at.items():
            text = "● measured" if name == "measured" else "◆ measured and estimated"
            scene.add_label(f"/{name}_label", text, position=(0.0, float(at[1]), 0.35 * size))
        self._site.initial_camera.position = (2.1 * size, 0.0, 0.3 * size)
        self._site.initial_camera.look_at = (0.0, 0.0, -0.35 * size)
