"""The page: what is seen, put into widgets, so often and no more."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.view.attendance import service_rows
from services.view.banner import Steady, banner
from services.view.bias_map import BiasPicture, project
from services.view.charts import Chart, Line, legend, signal_lines
from services.view.controls import Controls
from services.view.markup import (
    anomaly_html,
    banner_html,
    bias_html,
    facts_html,
    services_html,
    signals_html,
)
from services.view.rows import Row, rows
from services.view.scene import Scene
from services.view.seen import Seen
from services.view.styles import page
from services.view.teach_panel import TeachPanel
from services.view.trail import Trail

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

RATE = 12.0
"""Looks per second [Hz]; the 3D view goes with it."""
TABLES = 0.25
"""Time [s] between new numbers: faster cannot be read."""
CHARTS = 0.25
SLOW = 1.0
LEFT, RIGHT = 430, 400
"""Widths [px] of the two columns."""
GROUPED = {"Engage": "engage", "Disengage": "disengage", "Reset": "reset"}


@dataclass(slots=True)
class _Due:
    """When something is to be shown next [monotonic s]."""

    every: float
    at: float = 0.0

    def now(self, now: float) -> bool:
        if now < self.at:
            return False
        self.at = now + self.every
        return True


class Page:
    """All widgets of one robot.

    Args:
        site: The empty page.
        robot: The robot's name.
        look: Gives what is seen now; must not wait.
        controls: What the buttons do, or why there are none.
        urdf: The robot's URDF; None if there is none.
        taught: Where taught samples are recorded.
    """

    def __init__(
        self, site: "viser.ViserServer", robot: str, look: Callable[[], Seen], controls: Controls, urdf: Path | None,
        taught: Path,
    ) -> None:  # fmt: skip
        self._site, self._look, self._controls = site, look, controls
        self._trail, self._steady, self._bias = Trail(), Steady(), BiasPicture()
        self._chart, self._scores = Chart(180), Chart(100)
        self._rows: tuple[Row, ...] = ()
        self._choices: tuple[str, ...] = ()
        self._tables, self._charts, self._slow = _Due(TABLES), _Due(CHARTS), _Due(SLOW)
        site.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(92, 160, 230))
        self._scene = Scene(site, urdf)
        self._teach: TeachPanel | None = None
        self._make_left()
        self._make_right(robot, taught)

    def close(self) -> None:
        """Let the robot go, if it was taught."""
        if self._teach is not None:
            self._teach.close()

    def turn(self) -> None:
        """Look, remember, and show what is due; costs next to nothing while no browser looks."""
        now, seen = time.monotonic(), self._look()
        found = self._rows = rows(seen)
        self._trail.add(now, seen, found)
        if self._teach is not None:
            self._teach.show(seen, now)
        shown = self._steady.show(banner(seen, found), now)
        if not self._site.get_clients():
            return
        self._scene.show(seen, found)
        if self._tables.now(now):
            _set(self._signals, signals_html(found))
            _set(self._banner, banner_html(shown))
            _set(self._facts, facts_html(seen, source(seen), self._controls.read_only, self._controls.last))
        if self._charts.now(now):
            self._show_charts(seen, now)
        if self._slow.now(now):
            _set(self._services, services_html(service_rows(seen)))
            self._choose_from(found)
            self._show_bias(seen)

    def _make_left(self) -> None:
        gui = self._site.gui
        panel = gui.add_panel()
        with panel.add_tab("Signals"):
            self._signals = gui.add_html(page(""))
        panel.dock_left()
        panel.set_width(LEFT)

    def _make_right(self, robot: str, taught: Path) -> None:
        gui = self._site.gui
        gui.set_panel_label(robot)
        self._banner = gui.add_html(page(""))
        self._facts = gui.add_html(page(""))
        if not self._controls.read_only:
            self._make_buttons()
        tabs = gui.add_tab_group()
        with tabs.add_tab("Plots"):
            self._chosen = gui.add_dropdown("plot", ("-",))
            self._plot = gui.add_html(page(""))
            self._anomaly = gui.add_html(page(""))
        with tabs.add_tab("Body"):
            self._map = gui.add_html(page(""))
        with tabs.add_tab("Loops"):
            self._services = gui.add_html(page(""))
        if not self._controls.read_only:
            with tabs.add_tab("Teach"):
                self._teach = TeachPanel(self._site, self._controls, self._look, taught)
                self._teach.teacher.start()
        gui.main_panel.dock_right()
        gui.main_panel.set_width(RIGHT)

    def _make_buttons(self) -> None:
        import viser

        gui = self._site.gui
        group = gui.add_button_group("control", tuple(GROUPED))
        group.on_click(lambda event: self._press(GROUPED[event.target.value]))
        gui.add_button("Stop", color="orange", icon=viser.Icon.PLAYER_STOP).on_click(lambda _: self._press("stop"))
        gui.add_button("EMERGENCY STOP", color="red").on_click(lambda _: self._press("estop"))

    def _press(self, verb: str) -> None:
        if verb in ("stop", "estop", "disengage") and self._teach is not None:
            self._teach.teacher.let_go(f"{verb} was pressed, so the robot was let go.")
        self._controls.press(verb)

    def _choose_from(self, found: tuple[Row, ...]) -> None:
        signals = tuple(dict.fromkeys(row.signal for row in found))
        choices = (*signals, *(row.name for row in found))
        if choices and choices != self._choices:
            self._choices = choices
            self._chosen.options = choices  # what was chosen stays, if it is there

    def _show_charts(self, seen: Seen, now: float) -> None:
        chosen = self._chosen.value
        found = [row for row in self._rows if chosen in (row.signal, row.name)]
        if found:
            curves = self._trail.curves([row.name for row in found], now)
            lines = signal_lines([row.element for row in found], curves.measured, curves.estimated)
            _set(self._plot, page(self._chart.svg(curves.time, lines, found[0].unit, chosen) + legend(lines)))
        time, score, threshold = self._trail.judged(now)
        judged = [Line("score", score, "#7cc0ff"), Line("threshold", threshold, "#ff7b7b", dashed=True)]
        _set(self._anomaly, anomaly_html(seen) + page(self._scores.svg(time, judged, "score", "score")))

    def _show_bias(self, seen: Seen) -> None:
        biases: dict[str, Any] = dict(seen.model.get("biases", {}))
        found = project(biases, self._trail.bias()) if biases else None
        update = seen.fresh(seen.update)
        picture = "" if found is None else self._bias.svg(found, update is None)
        _set(self._map, bias_html(found, picture, update))


def source(seen: Seen) -> str:
    """Where what is shown comes from."""
    sample = seen.fresh(seen.sample)
    if sample is None:
        return "nothing comes"
    if "replay" in sample.source:
        return "replay of a recording"
    if sample.source == "simulated" or "simulator" in seen.alive:
        return "simulated robot"
    return f"robot ({sample.source})"


def _set(handle: Any, content: str) -> None:
    if handle.content != content:
        handle.content = content


def serve_page(turn: Callable[[], None], stop: threading.Event) -> None:
    """Turn the page until told to stop; a turn that fails is logged, and the next one is made."""
    from services.process.loop import Loop

    loop = Loop("page", RATE, turn)
    loop.start()
    stop.wait()
    loop.stop(2.0)
