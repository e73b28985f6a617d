"""The page: widgets that show the snapshots of a robot, at fixed rates."""

import copy
import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.view.bias_map import BiasPicture, project
from services.view.charts import Chart, Line, legend, signal_lines
from services.view.controls import Controls
from services.view.markup import (
    anomaly_html,
    banner_html,
    bias_html,
    facts_html,
    legend_html,
    services_html,
    signals_html,
)
from services.view.replay_panel import ReplayPanel, replay_of
from services.view.scene import Looks, Scene
from services.view.styles import page
from services.view.teach_panel import TeachPanel
from services.view.trail import Trail
from services.watch.service_rows import Level, service_rows
from services.watch.signal_rows import SignalRow, signal_rows
from services.watch.snapshot import RobotSnapshot, fresh
from services.watch.trouble import HEALTHY, Trouble, troubles

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

RATE = 12.0
"""The state is read and the 3D view updated at this rate [Hz]."""
TABLES = 0.25
"""Tables are written at this interval [s]; faster ones cannot be read."""
CHARTS = 0.25
"""Plots are written at this interval [s]."""
SLOW = 1.0
"""Loops and the map of p are written at this interval [s]."""
LINGERS = 1.0
"""A trouble stays on the page for this time [s] after it has passed."""
LEFT, RIGHT = 430, 400
"""The left and right columns have these widths [px]."""
GROUPED = {"Engage": "engage", "Disengage": "disengage", "Reset": "reset"}


@dataclass(slots=True)
class _Due:
    """Interval [s] and next time [monotonic s] of an update of the page."""

    every: float
    at: float = 0.0

    def now(self, now: float) -> bool:
        if now < self.at:
            return False
        self.at = now + self.every
        return True


class Steady:
    """Filter of the banner: a worse trouble is shown at once, a milder one after a while, so that the page is quiet."""

    def __init__(self) -> None:
        self._shown: Sequence[Trouble] = ()
        self._seen_at = -math.inf

    def show(self, new: Sequence[Trouble], now: float) -> Sequence[Trouble]:
        """Return the troubles to show at this time [monotonic s]."""
        if _level(new) >= _level(self._shown) or now - self._seen_at > LINGERS:
            self._shown, self._seen_at = new, now
        return self._shown


def _level(troubles: Sequence[Trouble]) -> Level:
    return next(iter(troubles), HEALTHY).level


class Page:
    """All widgets of one robot.

    Args:
        site: The empty page.
        robot: Name of the robot.
        look: Function that returns the present snapshot; it must not wait.
        controls: Sender of the buttons' requests.
        looks: Look of the robot.
        taught: File of taught samples.
    """

    def __init__(
        self, site: "viser.ViserServer", robot: str, look: Callable[[], RobotSnapshot], controls: Controls,
        looks: Looks, taught: Path,
    ) -> None:  # fmt: skip
        self._site, self._look, self._controls = site, look, controls
        self._trail, self._steady, self._bias = Trail(), Steady(), BiasPicture()
        self._charts, self._scores = (Chart(170), Chart(170)), Chart(100)
        self._at = 0.0
        """The right end of the plots is at this time [monotonic s], which stands still while a replay is paused."""
        self._paused: tuple[Trail, float] | None = None
        """Past values and time [monotonic s] at which the plots were paused."""
        self._rows: tuple[SignalRow, ...] = ()
        self._choices: tuple[str, ...] = ()
        self._tables, self._plots, self._slow = _Due(TABLES), _Due(CHARTS), _Due(SLOW)
        site.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(92, 160, 230))
        self._scene, self._looks = Scene(site, looks), looks
        self._group: Any = None
        self._stops: tuple[Any, ...] = ()
        self._is_replay = False
        self._replay: ReplayPanel | None = None
        self._teach: TeachPanel | None = None
        self._make_left()
        self._make_right(robot, taught)

    def close(self) -> None:
        """End teaching."""
        if self._teach is not None:
            self._teach.close()

    def turn(self) -> None:
        """Read the state and write what is due; without a browser nothing is written."""
        now, snapshot = time.monotonic(), self._look()
        rows = self._rows = signal_rows(snapshot)
        replay = replay_of(snapshot)
        if replay.get("paused") is not True:
            self._at = now
            self._trail.add(now, snapshot, rows)
        self._scene.follow(snapshot, rows)
        if self._teach is not None:
            self._teach.show(snapshot, now)
        shown = self._steady.show(troubles(snapshot, rows), now)
        if not self._site.get_clients():
            return
        self._scene.show(snapshot, rows)
        self._switch(bool(replay))
        if self._replay is not None:
            self._replay.show(snapshot)
        if self._tables.now(now):
            _set(self._signals, legend_html(bool(self._looks.wires)) + signals_html(rows))
            _set(self._banner, banner_html(shown))
            _set(self._facts, facts_html(snapshot, source(snapshot), self._controls.read_only, self._controls.last))
        if self._plots.now(now):
            self._show_charts(snapshot, self._at)
        if self._slow.now(now):
            _set(self._services, services_html(service_rows(snapshot)))
            self._choose_from(rows)
            self._show_bias(snapshot)

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
            self._replay = ReplayPanel(self._site, self._controls)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Plots"):
            self._pause = gui.add_checkbox("pause plots", False)
            self._pause.on_update(lambda _: self._pause_plots())
            self._chosen = gui.add_dropdown("plot", ("-",)), gui.add_dropdown("second plot", ("-",))
            self._curves = gui.add_html(page("")), gui.add_html(page(""))
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
        stop = gui.add_button("Stop", color="orange", icon=viser.Icon.HAND_STOP)
        stop.on_click(lambda _: self._press("stop"))
        estop = gui.add_button("EMERGENCY STOP", color="red")
        estop.on_click(lambda _: self._press("estop"))
        self._group, self._stops = group, (stop, estop)

    def _switch(self, is_replay: bool) -> None:
        """Switch the buttons that move a robot off in a replay, and on again for a robot."""
        if is_replay == self._is_replay:
            return
        self._is_replay = is_replay
        if self._group is not None:
            self._group.visible = not is_replay  # viser cannot disable a group
        for button in self._stops:
            button.disabled = is_replay
        if self._teach is not None:
            self._teach.switch(not is_replay)

    def _press(self, verb: str) -> None:
        if verb in ("stop", "estop", "disengage") and self._teach is not None:
            self._teach.teacher.let_go(f"{verb} was pressed, so the robot was let go.")
        self._controls.press(verb)

    def _choose_from(self, rows: tuple[SignalRow, ...]) -> None:
        signals = tuple(dict.fromkeys(row.signal for row in rows))
        choices = (*signals, *(row.name for row in rows))
        if choices and choices != self._choices:
            self._choices = choices
            first, second = self._chosen
            first.options, second.options = choices, ("-", *choices)  # a present choice stays if it is among them

    def _pause_plots(self) -> None:
        is_paused = self._pause.value
        self._paused = (copy.deepcopy(self._trail), self._at) if is_paused else None

    def _show_charts(self, snapshot: RobotSnapshot, now: float) -> None:
        trail, now = self._paused or (self._trail, now)
        at = "" if self._paused is None else time.strftime("%H:%M:%S", time.localtime(time.time() - _since(now)))
        for chart, choice, plot in zip(self._charts, self._chosen, self._curves, strict=True):
            chosen = choice.value
            rows = [row for row in self._rows if chosen in (row.signal, row.name)]
            if not rows:
                _set(plot, page(""))
                continue
            curves = trail.curves([row.name for row in rows], now)
            lines = signal_lines([row.element for row in rows], curves.measured, curves.estimated, curves.std)
            _set(plot, page(chart.svg(curves.time, lines, rows[0].unit, chosen, at) + legend(lines)))
        times, score, threshold = trail.scores(now)
        lines = [Line("score", score, "#7cc0ff"), Line("threshold", threshold, "#ff7b7b", dashed=True)]
        _set(self._anomaly, anomaly_html(snapshot) + page(self._scores.svg(times, lines, "score", "score", at)))

    def _show_bias(self, snapshot: RobotSnapshot) -> None:
        biases: dict[str, Any] = dict(snapshot.model.get("biases", {}))
        bias_map = project(biases, self._trail.bias()) if biases else None
        update = fresh(snapshot.update)
        picture = "" if bias_map is None else self._bias.svg(bias_map, update is None)
        _set(self._map, bias_html(bias_map, picture, update))


def source(snapshot: RobotSnapshot) -> str:
    """Return the source of the samples, in words."""
    sample = fresh(snapshot.sample)
    if sample is None:
        return "no samples"
    if "replay" in sample.source:
        return "replay of a recording"
    if sample.source == "simulated" or "simulator" in snapshot.alive:
        return "simulated robot"
    return f"robot ({sample.source})"


def _since(moment: float) -> float:
    return time.monotonic() - moment


def _set(handle: Any, content: str) -> None:
    if handle.content != content:
        handle.content = content


def serve_page(turn: Callable[[], None], stop: threading.Event) -> None:
    """Call `turn` until `stop` is set; an error in a turn is logged, and the next turn follows."""
    from services.process.loop import Loop

    loop = Loop("page", RATE, turn)
    loop.start()
    stop.wait()
    loop.stop(2.0)
