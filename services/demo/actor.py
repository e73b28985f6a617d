"""Actions of every story: engage the controller, send a target, wait, and continue after the HAL stopped the robot."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gemuco.errors import NotEnoughData
from hal.errors import CommandRefused
from services.client import Client
from services.errors import NoAnswer, NotEngaged, ServiceError, TooLate

NOTICED_WITHIN = 3.0
"""An event must be reported within this time [s]."""
ENGAGED_WITHIN = 1.0
REACHED_WITHIN = 10.0
"""A service must be reached within this time [s]: after the machine stood still, all connections are made anew."""
FOLLOWS_WITHIN = 15.0
"""The robot must follow within this time [s], in which nodes restart and refused requests are repeated."""
STEADY = 0.3
"""An event is noticed when it is reported for this long [s]: on a busy machine one late message looks like it."""
AGAIN = 0.05
"""Before a request is repeated the client receives samples for this time [s]."""
LONGEST_STEP = 0.1
"""A wait counts at most this time [s] per look at its condition; the rest of a stall of the machine does not count."""
TRIES = 3
"""A target is sent at most this often if the HAL stops the robot before the end."""


class NotFollowing(ServiceError):
    """The robot does not follow after all attempts to engage the controller."""


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage of a story.

    Attributes:
        name: Name of the stage.
        start: Start of the stage [s of the timeline].
        end: End of the stage [s of the timeline].
        figures: Sentences on measured values, in physical units.
        observed: Whether the expected event was observed.
    """

    name: str
    start: float
    end: float
    figures: tuple[str, ...]
    observed: bool


def hal_works(client: Client) -> bool:
    """Whether the HAL runs; one that is degraded does if all of its devices answer, as servos without a watchdog do."""
    status = client.status("hal")
    if status is None or status.state == "running":
        return status is not None
    sample = client.sample() if status.state == "degraded" else None
    return sample is not None and sample.complete and all(valid.all() for valid in sample.valid.values())


class Actor:
    """Client program that moves the robot of a story."""

    def __init__(self, client: Client, idle: Callable[[], None], report: Callable[[str], None]) -> None:
        """Call `idle` repeatedly while waiting, and `report` with a line of text per event."""
        self._client, self._idle, self._report = client, idle, report
        self.stops = 0
        """Number of times that the HAL stopped the robot by itself."""
        self.played: list[Stage] = []
        """Stages played so far."""

    def engage(self) -> None:
        """Engage the controller, after a reset if the robot or a drive has a fault; try again after a refusal.

        Raises:
            NotFollowing: The robot does not follow.
        """
        refusal = ""
        deadline = time.monotonic() + FOLLOWS_WITHIN
        while not self._follows():
            if time.monotonic() > deadline:
                raise NotFollowing(f"The arm did not begin to follow. {refusal or 'See the logs beside the plot.'}")
            try:
                if self._mode() == "fault" or not hal_works(self._client):
                    self._client.reset()
                    self.wait(lambda: self._mode() == "off" and hal_works(self._client), ENGAGED_WITHIN)
                self._client.engage()
            except (NotEngaged, CommandRefused, NoAnswer) as error:
                refusal = str(error)
            self.wait(self._follows, ENGAGED_WITHIN)

    def go(
        self,
        signal: str,
        values: np.ndarray,
        duration: float,
        stays: Callable[[], bool] = lambda: False,
        ends: Callable[[], Callable[[], bool]] = lambda: lambda: False,
    ) -> None:
        """Send a target [its unit], shape (n,), and wait; repeat if the HAL stopped the robot.

        Args:
            signal: The signal of the target.
            values: The target.
            duration: Longest wait [s].
            stays: Whether a robot that was stopped stays so; if it is true within a moment, the robot is left as it is
                for the duration.
            ends: Called when a target was sent; it returns a function that returns whether the wait ends.
        """
        for _ in range(TRIES):
            if not self._follows():
                if self.wait(stays, STEADY):
                    self.wait(lambda: False, duration)
                    return
                self._recover()
            self._insist(lambda: self._client.ask("model", "target", {"signal": signal, "values": values.tolist()}))
            self.wait(ends(), duration)
            if self._follows():
                return

    def learn_normal(self, move: Callable[[], None], tries: int) -> str:
        """Learn what is normal for this body, which is not the designer's; return a sentence on it.

        Args:
            move: Moves the robot, which brings more samples.
            tries: Number of times that it is tried, with moves between.
        """
        refusal = ""
        for left in reversed(range(tries)):
            try:
                reply = self._client.learn_normal()
                return f"statistics of normal errors learned anew from {reply['samples']} samples"
            except NotEnoughData as error:
                refusal = f"statistics of normal errors not learned: {error}"
            if left:  # a robot of many elements needs more samples
                move()
        return refusal

    def fault(self, text: str, service: str = "simulator") -> None:
        """Break a part of the simulated robot, or mend it; see `Client.fault`."""
        self._insist(lambda: self._client.fault(text, service))

    def wait(self, condition: Callable[[], bool], duration: float) -> bool:
        """Wait until the condition is true, at most `duration` [s] without stalls; return whether it became true."""
        left, looked = duration, time.monotonic()
        while not condition():
            if left <= 0:
                return False
            self._idle()
            time.sleep(0.01)
            now = time.monotonic()
            left, looked = left - min(now - looked, LONGEST_STEP), now
        return True

    def notice(self, is_reported: Callable[[], bool]) -> tuple[bool, float]:
        """Return whether an event is reported, and stays reported for a while, and the delay until then [s]."""
        start = time.monotonic()
        while (left := start + NOTICED_WITHIN - time.monotonic()) > 0 and self.wait(is_reported, left):
            delay = time.monotonic() - start
            if not self.wait(lambda: not is_reported(), STEADY):
                return True, delay
        return False, time.monotonic() - start

    def truth(self, signal: str) -> np.ndarray:
        """Return the true value of a signal now [its unit], shape (n,).

        Raises:
            ServiceError: The simulator does not answer.
        """
        truth = self._client.truth(timeout=NOTICED_WITHIN)
        if truth is None:
            raise ServiceError("The simulator does not publish the truth any more; see the logs beside the plot.")
        return truth.values[signal]

    def play(self, stage: Callable[[], Stage]) -> Stage:
        """Play one stage and report its measured values."""
        played = stage()
        self.played.append(played)
        for figure in played.figures:
            self._report(f"    {figure}")
        if not played.observed:
            self._report("    [red]The expected event was not observed.[/]")
        return played

    def _recover(self) -> None:
        """Continue after the HAL stopped the arm: report the reason, reset and engage again."""
        mode, status = self._mode(), self._client.status("hal", timeout=1.0)
        fault, estimate = status.facts.get("fault") if status else "", self._client.estimate()
        lies = [] if estimate is None else [f"{name} is {why}." for name, why in estimate.distrusted.items()]
        reason = f"({mode}). {fault or ' '.join(lies) or 'Commands came too late.'}"
        self._report(f"    [yellow]The HAL stopped the arm {reason} It is reset and engaged again.[/]")
        self.stops += 1
        self.engage()

    def _insist(self, ask: Callable[[], object]) -> None:
        """Ask again while the service does not answer, or refuses because this machine was too slow to ask in time.

        It ends after `REACHED_WITHIN`; `idle` notices if the service has ended.
        """
        deadline = time.monotonic() + REACHED_WITHIN
        while True:
            try:
                ask()
            except (NoAnswer, TooLate):
                if time.monotonic() > deadline:
                    raise
                self._idle()
                time.sleep(AGAIN)
            else:
                return

    def _follows(self) -> bool:
        return self._mode() in ("hold", "follow")

    def _mode(self) -> str:
        applied = self._client.applied(timeout=0.5)
        return "unknown" if applied is None else applied.mode
