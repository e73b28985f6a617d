"""Teaching panel: sliders, a button that moves the robot while it is held, and a button that records."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gemuco.errors import SchemaError
from hal.errors import HalError
from services.errors import ServiceError
from services.view.controls import Controls
from services.view.markup import teach_html
from services.view.taught import TaughtFile, posture
from services.view.teaching import STEP, NotTeaching, Reach, Teacher
from services.watch.snapshot import RobotSnapshot

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

EVERY = 1.0
"""The page that took over is queried at this interval [s]."""
NOTCHES = 500
"""A slider has this number of steps."""


class TeachPanel:
    """Widgets of a `Teacher` and a `TaughtFile`.

    Args:
        site: The page.
        controls: Source of a client that may command.
        look: Function that returns the present snapshot.
        path: File of the recorded samples.
    """

    def __init__(
        self, site: "viser.ViserServer", controls: Controls, look: Callable[[], RobotSnapshot], path: Path
    ) -> None:
        self._site, self._look = site, look
        self.teacher = Teacher(controls.open_client)
        self.file = TaughtFile(path)
        self._message = ""
        self._reach: Reach | None = None
        self._sliders: list[Any] = []
        self._is_teaching = False
        self._queried_at = 0.0
        self._status = site.gui.add_html("")
        self._take = site.gui.add_button("Take over and hold", color="yellow")
        self._folder = site.gui.add_folder("where to", visible=False)
        self._move = site.gui.add_button("Hold down to move there", visible=False, color="blue")
        self._step = site.gui.add_button(f"One step, {STEP:.0%} of the range", visible=False)
        self._condition = site.gui.add_text("condition", "", hint="Name of the body's condition, such as its tool.")
        self._record = site.gui.add_button("Record this posture", color="green")
        self._undo = site.gui.add_button("Take the last one back")
        self._wire()

    def close(self) -> None:
        """Let the robot go and end the thread."""
        self.teacher.stop()

    def switch(self, is_on: bool) -> None:
        """Switch the buttons that move the robot or record it off, as in a replay, or on."""
        for button in (self._take, self._record):
            button.disabled = not is_on

    def show(self, snapshot: RobotSnapshot, now: float) -> None:
        """Show the state of teaching, and query the page that took over."""
        self._make_sliders(snapshot)
        owner = self.teacher.owner
        teaching = owner is not None and self.teacher.set_point is not None
        if teaching != self._is_teaching:
            self._is_teaching = teaching
            for handle in (self._folder, self._move, self._step):
                handle.visible = teaching
            self._take.label = "Let go" if owner is not None else "Take over and hold"
            if teaching:
                self._place_sliders()
        if owner is not None and now - self._queried_at > EVERY:
            self._queried_at = now
            self._site._thread_executor.submit(self._query_page, owner)
        html = teach_html(owner is not None, self.teacher.is_moving, self._message or self.teacher.text, self.file)
        if html != self._status.content:
            self._status.content = html

    def _wire(self) -> None:
        self._take.on_click(lambda event: self._try(lambda: self._take_or_let_go(_browser(event))))
        self._move.on_hold(lambda event: self.teacher.hold(_browser(event)), callback_hz=10.0)
        self._step.on_click(lambda event: self.teacher.step(_browser(event)))
        self._record.on_click(lambda _: self._try(self._add))
        self._undo.on_click(lambda _: self._try(lambda: f"Taken back; {self.file.undo()} samples are in the file."))
        self._site.on_client_disconnect(
            lambda client: self.teacher.let_go(
                "The page that taught was closed, so the robot was let go.", client.client_id
            )
        )

    def _try(self, act: Callable[[], str]) -> None:
        try:
            self._message = act()
        except (ServiceError, HalError, SchemaError) as error:
            self._message = str(error)

    def _take_or_let_go(self, owner: int) -> str:
        if self.teacher.owner is not None:
            self.teacher.let_go("Let go.")
            return ""
        snapshot = self._look()
        model = snapshot.statuses.get("model")
        control = model.message.facts.get("control") if model is not None and model.is_fresh else None
        if isinstance(control, dict) and control.get("engaged"):
            raise NotTeaching("The model's controller moves the robot. Disengage it first.")
        self._reach = Reach.of(snapshot.hal)
        self.teacher.take_over(owner, self._reach)
        return ""

    def _add(self) -> str:
        layout, values = posture(self._look())
        count = self.file.add(self._condition.value, layout, values)
        return f"Recorded under '{self._condition.value.strip()}'; {count} samples are in the file."

    def _make_sliders(self, snapshot: RobotSnapshot) -> None:
        """Make the sliders of the commanded signal when its limits are known, and again when they change."""
        try:
            reach = Reach.of(snapshot.hal)
        except NotTeaching as error:
            if snapshot.hal:
                self._message = str(error)
            return
        known = self._reach
        if (
            self._sliders
            and known is not None
            and known.elements == reach.elements
            and np.array_equal(known.low, reach.low)
        ):
            return
        for slider in self._sliders:
            slider.remove()
        self._reach, self._sliders = reach, []
        with self._folder:
            for element, low, high in zip(reach.elements, reach.low, reach.high, strict=True):
                step = float(f"{(high - low) / NOTCHES:.1g}")
                slider = self._site.gui.add_slider(
                    f"{element} [{reach.unit}]", min=float(low), max=float(high), step=step,
                    initial_value=float(round((low + high) / 2 / step) * step),
                )  # fmt: skip
                slider.on_update(lambda _: self._set_target())
                self._sliders.append(slider)

    def _place_sliders(self) -> None:
        at = self.teacher.set_point
        if at is None or self._reach is None:
            return
        for slider, value, low, high in zip(self._sliders, at, self._reach.low, self._reach.high, strict=True):
            slider.value = float(np.clip(value, low, high))

    def _set_target(self) -> None:
        self.teacher.set_target(np.array([slider.value for slider in self._sliders]))

    def _query_page(self, owner: int) -> None:
        """Query the page's program; its answer shows that the page does not hang."""
        client = self._site.get_clients().get(owner)
        try:
            if client is not None:
                client.local_storage.get_item("gemuco", timeout=EVERY)
                self.teacher.confirm_page(owner)
        except (RuntimeError, TimeoutError) as error:
            log.info("The page that teaches did not answer: %s", error)


def _browser(event: Any) -> int:
    return int(event.client_id)
