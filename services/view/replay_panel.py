"""Panel of a replay: pause, single steps, and a slider over the whole recording."""

import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from services.view.controls import Controls
from services.watch.snapshot import RobotSnapshot

if TYPE_CHECKING:
    import viser

STEPS = {"1 sample": 1, "20 samples": 20, "200 samples": 200}
FINE = 0.01
"""The slider has steps of this time [s]."""


def replay_of(snapshot: RobotSnapshot) -> Mapping[str, Any]:
    """Return the facts of the replay that takes the robot's place; empty for a robot."""
    replay = snapshot.facts("hal").get("replay")
    return replay if isinstance(replay, dict) else {}


class ReplayPanel:
    """Widgets of a replay, which are not visible for a robot.

    Args:
        site: The page.
        controls: Sender of the requests.
    """

    def __init__(self, site: "viser.ViserServer", controls: Controls) -> None:
        self._controls = controls
        self._is_shown = self._is_paused = False
        self._lock = threading.Lock()
        self._wanted: float | None = None
        self._is_seeking = False
        gui = site.gui
        self._toggle = gui.add_button("Pause", visible=False, color="blue")
        self._steps = gui.add_button_group("step", tuple(STEPS), visible=False)
        self._place: Any = gui.add_slider("time [s]", min=0.0, max=1.0, step=FINE, initial_value=0.0, visible=False)
        self._toggle.on_click(lambda _: self._press("play" if self._is_paused else "pause"))
        self._steps.on_click(lambda event: self._press("step", count=STEPS[event.target.value]))
        self._place.on_update(lambda event: self._seek(event.target.value) if event.client_id is not None else None)

    def show(self, snapshot: RobotSnapshot) -> None:
        """Show the place of a replay, or hide the panel."""
        replay = replay_of(snapshot)
        length, position = (round(_number(replay.get(name)), 2) for name in ("length", "position"))
        is_shown = bool(replay) and length > 0.0
        if is_shown != self._is_shown:
            self._is_shown = is_shown
            for handle in (self._toggle, self._steps, self._place):
                handle.visible = is_shown
        if not is_shown:
            return
        if self._place.max != length:
            self._place.max = length
        self._is_paused = replay.get("paused") is True
        label = "Play" if self._is_paused else "Pause"
        if self._toggle.label != label:
            self._toggle.label = label
        place = round(min(position, length) / FINE) * FINE
        if not self._is_seeking and abs(self._place.value - place) > FINE:
            self._place.value = place

    def _press(self, verb: str, **arguments: int) -> None:
        self._controls.replay(verb, **arguments)

    def _seek(self, to: float) -> None:
        """Request the newest place of the slider; a drag changes it faster than requests are answered."""
        with self._lock:
            self._wanted = to
            if self._is_seeking:
                return
            self._is_seeking = True
        while True:
            with self._lock:
                wanted, self._wanted = self._wanted, None
                if wanted is None:
                    self._is_seeking = False
                    return
            self._controls.replay("seek", to=wanted)


def _number(fact: object) -> float:
    return float(fact) if isinstance(fact, int | float) else 0.0
