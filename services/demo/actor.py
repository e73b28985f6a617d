"""What every story does with a robot: take over, send it somewhere, wait, and go on after the HAL stopped it."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hal.errors import CommandRefused
from services.client import Client
from services.errors import NotEngaged, ServiceError

NOTICED_WITHIN = 3.0
"""Time [s] within which what happens must be told."""
ENGAGED_WITHIN = 1.0
FOLLOWS_WITHIN = 15.0
"""Time [s] that it may take to be followed: drives let go, nodes come back, and what refused once is asked again."""
TRIES = 3
"""How often one target is given, if the HAL stops the robot on the way each time."""


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage of a story.

    Attributes:
        name: What happened.
        start: When it began [s of the timeline].
        end: When it ended.
        figures: What was measured, in physical units.
        observed: Whether what the stage is about was really seen.
    """

    name: str
    start: float
    end: float
    figures: tuple[str, ...]
    observed: bool


class Actor:
    """Moves a robot through a client, as any remote program could."""

    def __init__(self, client: Client, idle: Callable[[], None], tell: Callable[[str], None]) -> None:
        """`idle` is called all the time while waiting, `tell` with what happens."""
        self._client, self._idle, self._tell = client, idle, tell
        self.stops = 0
        """How often the HAL stopped the robot by itself."""

    def engage(self) -> None:
        """Engage, out of a fault too, and again if the moment was a bad one: a sample may be late just then.

        Raises:
            ServiceError: The robot does not follow.
        """
        refusal = ""
        deadline = time.monotonic() + FOLLOWS_WITHIN
        while not self._follows():
            if time.monotonic() > deadline:
                raise ServiceError(f"The arm did not begin to follow. {refusal or 'See the logs beside the plot.'}")
            try:
                if self._mode() == "fault":
                    self._client.reset()
                    self.wait(lambda: self._mode() == "off" and self._is_healthy(), ENGAGED_WITHIN)
                self._client.engage()
            except (NotEngaged, CommandRefused) as error:
                refusal = str(error)
            self.wait(self._follows, ENGAGED_WITHIN)

    def go(self, signal: str, values: np.ndarray, duration: float) -> None:
        """Give a target [its unit], shape (n,), wait for so long [s]; again if the HAL stopped the robot on the way."""
        for _ in range(TRIES):
            if not self._follows():
                self._recover()
            self._client.ask("model", "target", {"signal": signal, "values": values.tolist()})
            self.wait(lambda: False, duration)
            if self._follows():
                return

    def wait(self, condition: Callable[[], bool], duration: float) -> bool:
        """Wait for so long [s] or until the condition holds; whether it did."""
        deadline = time.monotonic() + duration
        while not condition():
            if time.monotonic() >= deadline:
                return False
            self._idle()
            time.sleep(0.01)
        return True

    def truth(self, signal: str) -> np.ndarray:
        """What a signal really is now [its unit], shape (n,).

        Raises:
            ServiceError: The simulator does not tell.
        """
        truth = self._client.truth(timeout=NOTICED_WITHIN)
        if truth is None:
            raise ServiceError("The simulator does not tell the truth any more; see the logs beside the plot.")
        return truth.values[signal]

    def play(self, stage: Callable[[], Stage]) -> Stage:
        """Play one stage and tell what was measured."""
        done = stage()
        for figure in done.figures:
            self._tell(f"    {figure}")
        if not done.observed:
            self._tell("    [red]That is not what should have been seen.[/]")
        return done

    def _recover(self) -> None:
        """Go on after the HAL stopped the arm, as a person would: read why, reset, engage again."""
        mode, status = self._mode(), self._client.status("hal", timeout=1.0)
        fault = status.facts.get("fault") if status else ""
        why = f"({mode}). {fault or 'Commands came too late.'}"
        self._tell(f"    [yellow]The HAL stopped the arm {why} It is reset and engaged again.[/]")
        self.stops += 1
        self.engage()

    def _is_healthy(self) -> bool:
        status = self._client.status("hal")
        return status is not None and status.state == "running"

    def _follows(self) -> bool:
        return self._mode() in ("hold", "follow")

    def _mode(self) -> str:
        applied = self._client.applied(timeout=0.5)
        return "unheard" if applied is None else applied.mode
