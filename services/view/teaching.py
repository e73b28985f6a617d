"""Motion of a robot from the page: towards the sliders while a button is held, or by one step.

A thread sends set-points at a fixed rate, as any client does, and the HAL limits them. The thread lets the robot go
when the page that took over is closed or hangs, when the robot leaves the modes `hold` and `follow`, or when no
sample arrives; then the HAL stops as the robot file defines.
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
"""Set-points are sent at this rate [Hz]."""
SPEED = 0.3
"""Taught motion has this share of the robot file's rate limit."""
UNSTATED = 0.1
"""Without a rate limit, taught motion covers this share of the range per second."""
STEP = 0.02
"""One step covers at most this share of the range."""
PRESSED = 0.35
"""A button counts as held for this time [s] after its last message; it sends ten messages per second."""
PAGE_PATIENCE = 3.0
"""The page that took over may be silent for this time [s]."""
ENABLE_WITHIN = 5.0
"""The drives have to be enabled within this time [s]."""
LIVE = ("hold", "follow")


class NotTeaching(ServiceError):
    """Error for a robot that cannot be moved from the page at present; the text gives the reason."""


@dataclass(frozen=True, slots=True)
class Reach:
    """Limits of the commanded signal: bounds [unit] and speed [unit/s], each of shape (n,)."""

    signal: str
    unit: str
    elements: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    time_to_live: float

    @classmethod
    def of(cls, hal: Mapping[str, Any]) -> "Reach":
        """Return the limits in the answer of the HAL's `describe`.

        Raises:
            NotTeaching: The robot file states no bounds.
        """
        if not hal:
            raise NotTeaching("The HAL has not described its limits yet. Is it running?")
        if "command" not in hal:
            raise NotTeaching("The description of this robot has no command, so it cannot be taught.")
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
    """Sender of the set-points of one browser window, which took over the robot.

    Args:
        client: Function that returns the open client; it raises `ServiceError` if this page may not command.
        clock: Clock of the deadlines.
    """

    def __init__(self, client: Callable[[], Client], clock: Clock | None = None) -> None:
        self.text = ""
        """Reason why the robot was let go, or the state of enabling."""
        self._client, self._clock = client, clock or SystemClock()
        self._lock = threading.RLock()
        self._owner: int | None = None
        self._lease: Any = None
        self._reach: Reach | None = None
        self._at: np.ndarray | None = None
        self._target = np.zeros(0)
        self._goal: np.ndarray | None = None
        self._enable_by = self._held_until = self._page_at = -math.inf
        self._loop = Loop("teaching", RATE, self.tick, self._clock)

    def start(self) -> None:
        """Start the thread; it sends nothing before `take_over`."""
        self._loop.start()

    def stop(self) -> None:
        """Let the robot go and end the thread."""
        self.let_go("The page was ended.")
        self._loop.stop(2.0)

    @property
    def owner(self) -> int | None:
        """Browser window that took over; None if none did."""
        return self._owner

    @property
    def set_point(self) -> np.ndarray | None:
        """Set-point that is sent now [unit], shape (n,); None while none is sent."""
        at = self._at
        return None if at is None else at.copy()

    @property
    def is_moving(self) -> bool:
        """Whether a button is held, or a step is under way."""
        return self._goal is not None or self._clock.monotonic() < self._held_until

    def take_over(self, owner: int, reach: Reach) -> None:
        """Enable the drives at the present position and hold it.

        Raises:
            ServiceError, HalError: Another client commands, no service answers, or the HAL refuses.
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

    def set_target(self, values: np.ndarray) -> None:
        """Set the target from the sliders [unit], shape (n,); this moves nothing."""
        with self._lock:
            if self._reach is not None:
                self._target = np.clip(values, self._reach.low, self._reach.high)

    def hold(self, owner: int) -> None:
        """Move for the next 0.35 s; called repeatedly while the button is held."""
        with self._lock:
            if owner == self._owner:
                self._held_until = self._page_at = self._clock.monotonic()
                self._held_until += PRESSED

    def step(self, owner: int) -> None:
        """Move one step towards the target."""
        with self._lock:
            if owner == self._owner and self._reach is not None and self._at is not None:
                most = STEP * (self._reach.high - self._reach.low)
                self._goal = self._at + np.clip(self._target - self._at, -most, most)
                self._page_at = self._clock.monotonic()

    def confirm_page(self, owner: int) -> None:
        """Note that the page that took over has answered."""
        with self._lock:
            if owner == self._owner:
                self._page_at = self._clock.monotonic()

    def let_go(self, why: str = "", owner: int | None = None) -> None:
        """Send no more set-points, and let the HAL stop as the robot file defines.

        Args:
            why: Reason for the page.
            owner: Browser window that must have taken over; any if None.
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
            log.info("Let go, but the HAL did not confirm the stop: %s. Its watchdog stops the robot.", error)
        if lease is not None:
            lease.__exit__(None, None, None)

    def tick(self) -> None:
        """Send one set-point while a browser window teaches; let the robot go on any problem."""
        try:
            with self._lock:
                why = self._turn()
        except ServiceError as error:  # the lease was lost, or the connection
            why = f"{error} The robot was let go."
        if why:
            self.let_go(why)

    def _turn(self) -> str:
        """Send one set-point; return a reason to let the robot go, or an empty text."""
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
                return ""  # a client subscribes at its first call
            return "No sample comes from the HAL any more, so the robot was let go."
        if self._at is None:
            return self._begin(applied.mode, sample.values[reach.signal], sample.valid[reach.signal], now)
        if applied.mode not in LIVE:
            return f"The HAL went to '{applied.mode}', so the robot was let go."
        self._advance(reach, now)
        client.command(reach.signal, self._at, sample)
        return ""

    def _begin(self, mode: str, values: np.ndarray, valid: np.ndarray, now: float) -> str:
        """Take the present position as the first set-point when the drives are enabled."""
        if mode in LIVE and valid.all():
            self._at, self._target, self.text = values.copy(), values.copy(), ""
            return ""
        if now > self._enable_by or mode == "fault":
            return f"The drives did not become enabled (mode '{mode}'), so the robot was let go."
        return ""

    def _advance(self, reach: Reach, now: float) -> None:
        assert self._at is not None
        goal = self._target if now < self._held_until else self._goal
        if goal is None:
            return
        most = reach.speed / RATE
        self._at = self._at + np.clip(goal - self._at, -most, most)
        if self._goal is not None and np.allclose(self._at, self._goal, atol=1e-9):
            self._goal = None
