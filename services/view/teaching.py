"""Moving a robot by hand from the page: towards where the sliders are, only while a button is held, or one step.

A thread sends set-points at a fixed rate, as any client does, and the HAL limits them once more. It lets go at once
when the page that took over is closed or hangs, when the robot leaves the modes in which it follows, or when nothing
is measured; then the HAL stops as the robot file says.
"""

import logging
import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gemuco.errors import SchemaError
from hal.clock import Clock, SystemClock
from hal.config import per_element
from hal.errors import HalError
from services.client import Client
from services.errors import ServiceError
from services.process.loop import Loop

log = logging.getLogger(__name__)

RATE = 50.0
"""Set-points per second [Hz]."""
SPEED = 0.3
"""Share of the robot file's largest rate at which taught motion goes."""
UNSTATED = 0.1
"""Share of the range per second, where the robot file states no rate."""
STEP = 0.02
"""Share of the range that one step goes at most."""
PRESSED = 0.35
"""How long [s] a held button counts as held after it last said so; it says so ten times a second."""
PAGE_PATIENCE = 3.0
"""How long [s] the page that took over may be silent."""
ENABLE_WITHIN = 5.0
LIVE = ("hold", "follow")


class NotTeaching(ServiceError):
    """The robot cannot be moved from the page now; the text says why."""


@dataclass(frozen=True, slots=True)
class Reach:
    """Where the commanded signal may go: bounds [unit] and speed [unit/s], each of shape (n,)."""

    signal: str
    unit: str
    elements: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    time_to_live: float

    @classmethod
    def of(cls, hal: Mapping[str, Any]) -> "Reach":
        """As the HAL's `describe` tells.

        Raises:
            NotTeaching: The robot file states no bounds.
        """
        if not hal:
            raise NotTeaching("The HAL has not told its limits yet. Is it running?")
        signal = hal["command"]["signal"]
        about, limit = hal["signals"][signal], hal["limits"].get(signal, {})
        count = len(about["elements"])
        low, high = (per_element(limit.get(end), count, f"limits.{signal}.{end}") for end in ("low", "high"))
        if not (np.isfinite(low) & np.isfinite(high)).all():
            raise NotTeaching(f"The robot file needs limits.{signal} with low and high for every element to teach.")
        rate = per_element(limit.get("rate"), count, f"limits.{signal}.rate")
        speed = np.where(np.isfinite(rate), SPEED * rate, UNSTATED * (high - low))
        ttl = float(hal["command"]["time_to_live"])
        return cls(signal, about["unit"], tuple(about["elements"]), low, high, speed, ttl)


class Teacher:
    """Holds a robot, and moves it while it is told to.

    Args:
        client: Gives the open client; raises `ServiceError` when this page may not command.
        clock: For deadlines.
    """

    def __init__(self, client: Callable[[], Client], clock: Clock | None = None) -> None:
        self.text = ""
        """Why it let go last, or what it waits for."""
        self._client, self._clock = client, clock or SystemClock()
        self._lock = threading.RLock()
        self._owner: int | None = None
        self._lease: Any = None
        self._reach: Reach | None = None
        self._at: np.ndarray | None = None
        self._wish = np.zeros(0)
        self._goal: np.ndarray | None = None
        self._enable_by = self._held_until = self._page_at = -math.inf
        self._loop = Loop("teaching", RATE, self.tick, self._clock)

    def start(self) -> None:
        """Begin the thread; nothing is sent before `take_over`."""
        self._loop.start()

    def stop(self) -> None:
        """Let go, and end the thread."""
        self.let_go("The page was ended.")
        self._loop.stop(2.0)

    @property
    def owner(self) -> int | None:
        """The browser that took over; None if nobody did."""
        return self._owner

    @property
    def set_point(self) -> np.ndarray | None:
        """What is sent now [unit], shape (n,); None while nothing is."""
        at = self._at
        return None if at is None else at.copy()

    @property
    def is_moving(self) -> bool:
        """Whether a button is held, or a step is under way."""
        return self._goal is not None or self._clock.monotonic() < self._held_until

    def take_over(self, owner: int, reach: Reach) -> None:
        """Enable the robot where it is, and hold it there.

        Raises:
            ServiceError, HalError: Somebody else commands, nobody answers, or the HAL refuses.
        """
        client = self._client()
        with self._lock:
            if self._owner is not None and self._owner != owner:
                raise NotTeaching("Another browser window teaches this robot. Let go there first.")
        lease = client.lease()
        lease.__enter__()
        try:
            client.enable()
        except BaseException:
            lease.__exit__(None, None, None)
            raise
        with self._lock:
            now = self._clock.monotonic()
            self._owner, self._reach, self._at, self._goal, self._lease = owner, reach, None, None, lease
            self._enable_by, self._held_until, self._page_at = now + ENABLE_WITHIN, -math.inf, now
            self.text = "The drives are being enabled."

    def wish(self, values: np.ndarray) -> None:
        """Where the sliders are [unit], shape (n,); nothing moves by this alone."""
        with self._lock:
            if self._reach is not None:
                self._wish = np.clip(values, self._reach.low, self._reach.high)

    def hold(self, owner: int) -> None:
        """The button to move is held down, and says so again and again."""
        with self._lock:
            if owner == self._owner:
                self._held_until = self._page_at = self._clock.monotonic()
                self._held_until += PRESSED

    def step(self, owner: int) -> None:
        """Go one step towards where the sliders are."""
        with self._lock:
            if owner == self._owner and self._reach is not None and self._at is not None:
                most = STEP * (self._reach.high - self._reach.low)
                self._goal = self._at + np.clip(self._wish - self._at, -most, most)
                self._page_at = self._clock.monotonic()

    def page_lives(self, owner: int) -> None:
        """The page that took over has answered."""
        with self._lock:
            if owner == self._owner:
                self._page_at = self._clock.monotonic()

    def let_go(self, why: str = "", owner: int | None = None) -> None:
        """Send nothing any more, and have the HAL stop as the robot file says.

        Args:
            why: Told on the page.
            owner: Only if this browser took over; whoever did if None.
        """
        with self._lock:
            if self._owner is None or (owner is not None and owner != self._owner):
                return
            lease, self._lease = self._lease, None
            self._owner = self._reach = self._at = self._goal = None
            self.text = why
        try:
            self._client().stop()
        except (ServiceError, HalError, SchemaError) as error:
            log.info("Let go, and the HAL did not take it: %s. Its watchdog stops the robot.", error)
        if lease is not None:
            lease.__exit__(None, None, None)

    def tick(self) -> None:
        """Send one set-point, if somebody teaches and all is well."""
        try:
            with self._lock:
                why = self._turn()
        except ServiceError as error:  # the lease was lost, or the connection
            why = f"{error} The robot was let go."
        if why:
            self.let_go(why)

    def _turn(self) -> str:
        """Why to let go; empty if there is no reason."""
        reach = self._reach
        if self._owner is None or reach is None:
            return ""
        now = self._clock.monotonic()
        if now - self._page_at > PAGE_PATIENCE:
            return "The page that taught went away or hangs, so the robot was let go."
        client = self._client()
        sample, applied = client.sample(reach.time_to_live), client.applied(reach.time_to_live)
        if sample is None or applied is None:
            if self._at is None and now < self._enable_by:
                return ""  # a client subscribes when it is first asked
            return "No sample comes from the HAL any more, so the robot was let go."
        if self._at is None:
            return self._begin(applied.mode, sample.values[reach.signal], sample.valid[reach.signal], now)
        if applied.mode not in LIVE:
            return f"The HAL went to '{applied.mode}', so the robot was let go."
        self._advance(reach, now)
        client.command(reach.signal, self._at, sample)
        return ""

    def _begin(self, mode: str, values: np.ndarray, valid: np.ndarray, now: float) -> str:
        """Take where the robot is as the first set-point, once the drives are enabled."""
        if mode in LIVE and valid.all():
            self._at, self._wish, self.text = values.copy(), values.copy(), ""
            return ""
        if now > self._enable_by or mode == "fault":
            return f"The drives did not become enabled (mode '{mode}'), so the robot was let go."
        return ""

    def _advance(self, reach: Reach, now: float) -> None:
        assert self._at is not None
        goal = self._wish if now < self._held_until else self._goal
        if goal is None:
            return
        most = reach.speed / RATE
        self._at = self._at + np.clip(goal - self._at, -most, most)
        if self._goal is not None and np.allclose(self._at, self._goal, atol=1e-9):
            self._goal = None
