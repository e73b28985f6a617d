"""The control loop: targets in, commands out. It commands only while engaged and on a fresh sample."""

import math
import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from gemuco.intervals.sureness import SURE, UNKNOWN, Sureness
from hal.clock import Clock
from hal.config import RobotConfig
from services.errors import CommandHeld, NotEngaged, TargetRefused, TooLate
from services.model.control_config import ControlConfig
from services.model.estimation import Estimation, SampleSource
from services.wire.messages import Applied, Command, Sample, Target
from services.wire.plain_text import shown
from services.wire.streams import Arrival

BUMP = 0.3
"""The difference between the first command and the measured value decays with this time constant [s]."""
LONGEST_STEP = 0.1
"""A late tick moves the reference at most as far as this time [s] allows."""
SLOW = 0.1
"""Share of the speed of the reference where the body is unknown."""
LIVE_MODES = ("hold", "follow")
DEAD_MODES = ("off", "homing", "stopping", "fault")


class Solver(Protocol):
    """A solver for the command that reaches a target."""

    def __call__(self, target: Mapping[str, np.ndarray], now: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the command [its unit], shape (n,), for signal -> reference, starting from signal -> value now."""
        ...


def check_target(robot: RobotConfig, config: ControlConfig, target: Target) -> np.ndarray:
    """Return the reference of a valid target [unit of its signal], shape (n,).

    Raises:
        TargetRefused: It has another signal, a wrong size, a value that is not a number, or is outside of the limits.
    """
    if target.signal not in robot.signals:
        raise TargetRefused(f"Target signal {shown(target.signal)} is not a signal. Known: {', '.join(robot.signals)}.")
    if target.signal != config.target:
        raise TargetRefused(f"'{target.signal}' is not controlled; the robot file says '{config.target}' is.")
    signal = robot.signals[target.signal]
    if target.values.shape != (signal.size,):
        names = ", ".join(signal.elements)
        raise TargetRefused(f"A {target.signal} target has {signal.size} values ({names}), not {target.values.size}.")
    if not np.isfinite(target.values).all():
        raise TargetRefused(f"A {target.signal} target holds a value that is not a number.")
    low, high = robot.bounds(target.signal)
    for index in np.flatnonzero((target.values < low) | (target.values > high)):
        raise TargetRefused(
            f"{target.signal}.{signal.elements[index]} of {target.values[index]:.3f} {signal.unit} is outside of its "
            f"limits, {low[index]:.3f} to {high[index]:.3f} {signal.unit}."
        )
    return np.array(target.values, float)


def _towards(start: np.ndarray, end: np.ndarray, step: float) -> np.ndarray:
    """Return the point on a straight line whose elements are at most `step` from the start; the end if it is nearer."""
    distance = end - start
    longest = float(np.abs(distance).max())
    return end if longest <= step else start + distance * (step / longest)


class Control:
    """The controller: it moves a reference towards the target, solves for the command, and sends it while safe."""

    def __init__(
        self,
        robot: RobotConfig,
        config: ControlConfig,
        newest: SampleSource,
        applied: Callable[[], Applied | None],
        estimation: Estimation,
        solver: Solver,
        send: Callable[[Command], None],
        clock: Clock,
        judge: Callable[[np.ndarray], Sureness] = lambda _: SURE,
    ) -> None:
        """Prepare.

        Args:
            robot: The robot file's content.
            config: Its `control` section.
            newest: Returns the newest sample of the HAL.
            applied: Returns the newest applied set-points.
            estimation: The estimation loop.
            solver: Solves for the command.
            send: Sends a command.
            clock: Source of time.
            judge: Judges whether the body is known at a reference [unit of the target], shape (n,).
        """
        self._judge = judge
        self._robot, self._config, self._clock = robot, config, clock
        self._newest, self._applied, self._estimation = newest, applied, estimation
        self._solver, self._send = solver, send
        self._lock = threading.Lock()
        self._bump_begins = -math.inf
        self._ticked_at = -math.inf
        self._was_live = False
        self._reference: np.ndarray | None = None
        self._target: np.ndarray | None = None
        self._bump: np.ndarray | None = None
        self.engaged = False
        self.text = ""
        self.counters = {"sent": 0, "waited": 0, "refused_targets": 0}

    def set_target(self, target: Target) -> None:
        """Set a new target.

        Raises:
            TargetRefused: The target is not valid; the one before stays.
        """
        values = check_target(self._robot, self._config, target)
        there = self._judge(values)
        with self._lock:
            self._target, self.text = values, ""
            if there.state == UNKNOWN and self._config.unknown != "ignore":
                word = "is slow" if self._config.unknown == "slow" else "stops"
                self.text = f"The body is unknown at this target ({there.reason}), so the reference {word} before it."

    def try_target(self, target: Target, check: Callable[[Target], None] = lambda _: None) -> None:
        """Set a published target, whose sender gets no answer; `facts` reports and counts refusals.

        Args:
            target: The published target.
            check: Raises `CommandHeld` or `TooLate` if it must not be followed.

        Raises:
            TargetRefused, CommandHeld, TooLate: It is refused.
        """
        try:
            check(target)
            self.set_target(target)
        except (TargetRefused, CommandHeld, TooLate) as refusal:
            self.counters["refused_targets"] += 1
            self.text = str(refusal)
            raise

    def engage(self, enable: Callable[[], Any]) -> None:
        """Start from the present posture, and ask the HAL to enable.

        Raises:
            NotEngaged: There is no fresh sample, or the posture can neither be measured nor estimated.
        """
        if self._fresh() is None:
            raise NotEngaged("No fresh sample comes from the HAL, so the posture is unknown. Is it running?")
        posture = self._posture()
        if posture is None:
            raise NotEngaged(f"'{self._config.target}' can neither be measured nor estimated, so nothing is engaged.")
        enable()
        with self._lock:
            self._reference, self._target, self._bump = posture, None, None
            self._was_live = False
            self._ticked_at = self._clock.monotonic()
            self.engaged, self.text = True, ""

    def disengage(self, reason: str = "") -> None:
        """Stop commanding; the HAL then holds, and disables."""
        with self._lock:
            self.engaged, self.text = False, reason
            self._target = self._reference = None

    def tick(self) -> None:
        """Send one command if engaged, on a fresh sample, and in a mode in which the drives follow."""
        if not self.engaged:
            return
        fresh, mode = self._fresh(), self._mode()
        if self._was_live and mode in DEAD_MODES:
            self.disengage(f"The HAL went to '{mode}', so the controller disengaged. Engage it again after repair.")
            return
        if fresh is None or mode not in LIVE_MODES or self._estimation.latest is None:
            self.counters["waited"] += 1
            return
        self._was_live = True
        with self._lock:
            reference = self._advance()
            if reference is None:
                return
            values = self._command(reference, self._estimation.latest.values)
            if not np.isfinite(values).all():
                self.text = "The model's command is not a number; nothing was sent."
                return
            signal = self._robot.command.signal
            self._send(Command(signal=signal, values=values, cycle=fresh.message.cycle, hal_boot=fresh.message.boot))
            self.counters["sent"] += 1

    def facts(self) -> dict[str, Any]:
        """Return the state for the status message."""
        with self._lock:
            target = [] if self._target is None else self._target.tolist()
            reference = [] if self._reference is None else self._reference.tolist()
        return {"engaged": self.engaged, "target": target, "reference": reference, "text": self.text, **self.counters}

    def _fresh(self) -> Arrival[Sample] | None:
        fresh = self._newest()
        if fresh is None or self._clock.monotonic() - fresh.received > self._robot.command.time_to_live:
            return None
        return fresh

    def _mode(self) -> str:
        applied = self._applied()
        return "off" if applied is None else applied.mode

    def _posture(self) -> np.ndarray | None:
        latest = self._estimation.latest
        values = None if latest is None else latest.values.get(self._config.target)
        if values is None or not np.isfinite(values).all():
            return None
        low, high = self._robot.bounds(self._config.target)
        return np.clip(values, low, high)

    def _advance(self) -> np.ndarray | None:
        """Move the reference on a straight line towards the target, all elements arriving together."""
        now = self._clock.monotonic()
        step = self._config.speed * min(now - self._ticked_at, LONGEST_STEP)
        self._ticked_at = now
        if self._reference is not None and self._target is not None:
            ahead = _towards(self._reference, self._target, step)
            if self._config.unknown != "ignore" and not np.array_equal(ahead, self._reference):
                ahead = self._careful(ahead, self._target, step)
            self._reference = ahead
        return self._reference

    def _careful(self, ahead: np.ndarray, target: np.ndarray, step: float) -> np.ndarray:
        """Return the next reference: slower, or the present one, where the body is unknown.

        A reference that is outside already may come back to a target at which the body is known.
        """
        assert self._reference is not None
        there = self._judge(ahead)
        latest = self._estimation.latest
        if latest is not None and latest.state.get(self._config.target) == UNKNOWN:
            there = Sureness(UNKNOWN, latest.reason.get(self._config.target, ""))
        if there.state != UNKNOWN:
            return ahead
        if self._config.unknown == "hold" and self._judge(target).state == UNKNOWN:
            self.text = f"The reference holds, because the body is unknown ahead: {there.reason}."
            return self._reference
        self.text = f"The reference is slow, because the body is unknown: {there.reason}."
        return _towards(self._reference, target, SLOW * step)

    def _command(self, reference: np.ndarray, now: Mapping[str, np.ndarray]) -> np.ndarray:
        """Solve for the command, and blend it in from the measured values at the first tick."""
        solution = self._solver({self._config.target: reference}, now)
        measured = now[self._robot.command.signal]
        if self._bump is None:
            self._bump = np.where(np.isfinite(measured), measured - solution, 0.0)
            self._bump_begins = self._clock.monotonic()
        return solution + self._bump * math.exp(-(self._clock.monotonic() - self._bump_begins) / BUMP)
