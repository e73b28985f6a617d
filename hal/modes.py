"""The mode of the robot and its transitions."""

from collections.abc import Callable
from enum import StrEnum

from hal.actuators import Actuators
from hal.config import RobotConfig
from hal.device import Device, DeviceState
from hal.errors import CommandRefused

DISABLE_TIMEOUT = 1.0
"""The drives may take this time [s] to disable, including a quick stop."""
HOMING_TIMEOUT = 60.0
"""A device may take this time [s] to find its zero."""
QUICK_STOPS = 5
"""A quick stop is repeated in this number of cycles, because a frame may be lost."""
PARK_SETTLE = 0.3
"""The robot rests for this time [s] in its safe posture before its drives are disabled."""


class Mode(StrEnum):
    """Mode of the whole robot; the drives of a muscle arm must never be in different modes."""

    OFF = "off"
    ENABLING = "enabling"
    HOLD = "hold"
    """The drives are enabled and a position set-point is constant. A velocity is 0; an effort is 0 or damped."""
    FOLLOW = "follow"
    """The drives are enabled and follow a command that is younger than its time to live."""
    HOMING = "homing"
    """One device finds its zero; all others are off."""
    STOPPING = "stopping"
    """The robot performs the stop of the robot file, or waits until its drives are off; it takes no commands."""
    FAULT = "fault"
    """The robot is stopped and without power because of a problem; only `reset` ends this mode."""


class Act(StrEnum):
    """Action of the drives in a cycle."""

    IDLE = "idle"
    START = "start"
    """The set-point is the present position of the robot, so that no drive jumps."""
    HOLD = "hold"
    FOLLOW = "follow"
    DAMP = "damp"
    PARK = "park"


_STOPS = {"hold": Act.HOLD, "damp": Act.DAMP, "park": Act.PARK, "off": Act.IDLE}


class ModeMachine:
    """The mode, its deadlines, and the cause of a fault in one sentence. Not thread safe."""

    def __init__(self, actuators: Actuators, config: RobotConfig) -> None:
        self._actuators = actuators
        self._hold = config.command.hold
        self._enable_timeout = config.command.enable_timeout
        self._stop_act = _STOPS[config.stop.behaviour]
        hold = Act.DAMP if actuators.quantity == "effort" and self._stop_act is Act.DAMP else Act.HOLD
        self._acts = {Mode.ENABLING: Act.START, Mode.HOLD: hold, Mode.FOLLOW: Act.FOLLOW}
        self._park_time = _park_time(config)
        self._deadline = 0.0
        self._act = Act.IDLE
        self._quick_stops = 0
        self._is_emergency = False
        self._homing: Device | None = None
        self._homing_seen = False
        self._parked_at: float | None = None
        self.mode = Mode.OFF
        self.fault_text = ""

    @property
    def act(self) -> Act:
        """Action of the drives in this cycle."""
        return self._act if self.mode is Mode.STOPPING else self._acts.get(self.mode, Act.IDLE)

    @property
    def is_powered(self) -> bool:
        """Whether set-points are sent."""
        return self.act is not Act.IDLE

    @property
    def takes_commands(self) -> bool:
        """Whether the robot takes commands now."""
        return self.mode is Mode.FOLLOW or self.mode is Mode.HOLD

    def enable(self, now: float) -> None:
        """Ask all drives to start from their present position.

        Raises:
            CommandRefused: The robot is in fault, homing or stopping, or a drive is not ready.
        """
        if self.mode in (Mode.HOLD, Mode.FOLLOW, Mode.ENABLING):
            return
        self._check_off("enable")
        if not self._actuators.devices:
            raise CommandRefused("The robot has no device that can be commanded.")
        for device in self._actuators.devices:
            health = device.health()
            if health.state is not DeviceState.READY:
                raise CommandRefused(
                    f"'{device.name}' is {health.state}, not ready, so nothing was enabled. {health.text}".rstrip()
                )
        self._actuators.enable()
        self.mode = Mode.ENABLING
        self._deadline = now + self._enable_timeout

    def home(self, device: Device, now: float) -> None:
        """Ask one device to find its zero.

        Raises:
            CommandRefused: The robot is not off, or the device is not ready or has no homing.
        """
        self._check_off("home")
        health = device.health()
        if health.state is not DeviceState.READY:
            raise CommandRefused(f"'{device.name}' is {health.state}, not ready. {health.text}".rstrip())
        device.home()
        self._homing, self._homing_seen = device, False
        self.mode, self._deadline = Mode.HOMING, now + HOMING_TIMEOUT

    def tare(self, device: Device) -> None:
        """Ask a sensor to take what it measures as zero.

        Raises:
            CommandRefused: The robot is not off, or the device has no tare.
        """
        self._check_off("tare")
        device.tare()

    def _check_off(self, verb: str) -> None:
        if self.mode is Mode.FAULT:
            raise CommandRefused(f"The robot is in fault: {self.fault_text} Reset it first.")
        if self.mode is Mode.STOPPING:
            raise CommandRefused(f"The robot is still stopping. Ask to {verb} when its mode is 'off'.")
        if self.mode is not Mode.OFF:
            raise CommandRefused(f"The robot is in mode '{self.mode}'. Ask to {verb} when it is 'off'.")

    def disable(self, now: float) -> None:
        """Disable the drives at once; a device that is homing stops first."""
        if self.mode in (Mode.OFF, Mode.FAULT):
            return
        self._release(now, self._actuators.quick_stop if self.mode is Mode.HOMING else self._actuators.disable)

    def halt(self, now: float) -> None:
        """Stop as fast as the drives can, and disable them."""
        if self.mode not in (Mode.OFF, Mode.FAULT):
            self._release(now, self._actuators.quick_stop)

    def stop(self, now: float) -> None:
        """Perform the stop of the robot file, then disable the drives."""
        if self.mode in (Mode.HOLD, Mode.FOLLOW):
            self._begin_stop(now)
        elif self.mode in (Mode.ENABLING, Mode.HOMING):
            self.disable(now)

    def _begin_stop(self, now: float) -> None:
        if self._stop_act is Act.IDLE:
            self._release(now, self._actuators.disable)
            return
        self.mode, self._act, self._parked_at = Mode.STOPPING, self._stop_act, None
        self._deadline = now + (self._park_time if self._stop_act is Act.PARK else self._hold)

    def _release(self, now: float, request: Callable[[], None]) -> None:
        self.mode, self._act, self._deadline = Mode.STOPPING, Act.IDLE, now + DISABLE_TIMEOUT
        request()

    def fault(self, text: str) -> None:
        """Stop as fast as the drives can, and stay in fault until `reset`; the first cause is reported."""
        if self.mode is not Mode.FAULT:
            self.mode, self.fault_text, self._quick_stops = Mode.FAULT, text, QUICK_STOPS
        self._actuators.quick_stop()

    def emergency(self, text: str) -> None:
        """Enter the fault from any mode, also from `off` and `fault`; the caller stops the drives."""
        if self._is_emergency:
            text = self.fault_text
        elif self.mode is Mode.FAULT:
            text = f"{text} Before that: {self.fault_text}"
        self._is_emergency = True
        self.mode, self.fault_text, self._quick_stops = Mode.FAULT, text, QUICK_STOPS

    def reset(self) -> None:
        """Leave the fault, without enabling a drive.

        Raises:
            CommandRefused: The robot is enabled, or a drive still has power.
        """
        if self.mode not in (Mode.OFF, Mode.FAULT):
            raise CommandRefused(f"The robot is in mode '{self.mode}', there is no fault to reset.")
        powered = [device.name for device in self._actuators.devices if device.has_power]
        if powered:
            raise CommandRefused(f"Still enabled: {', '.join(powered)}. If they stay enabled, cut the power.")
        self.mode, self.fault_text, self._is_emergency = Mode.OFF, "", False

    def step(self, now: float, has_command: bool, is_parked: bool = False) -> None:
        """Enter the mode of this cycle.

        Args:
            now: Monotonic time [s].
            has_command: Whether an accepted command is younger than its time to live.
            is_parked: Whether the set-point is the safe posture.
        """
        if self.mode is Mode.FAULT:
            if self._quick_stops:
                self._quick_stops -= 1
                self._actuators.quick_stop()
            return
        states = self._actuators.states()
        problem = self._problem(states)
        if problem:
            self.fault(problem)
        elif self.mode is not Mode.OFF:
            _STEPS[self.mode](self, now, states, has_command, is_parked)

    def _problem(self, states: list[DeviceState]) -> str:
        """Return the reason to stop all drives, given their states; empty without a reason."""
        if self.mode is Mode.OFF or self.mode is Mode.HOMING:
            for device, state in zip(self._actuators.devices, states, strict=True):
                is_powered = state in _POWERED or (state is DeviceState.FAULT and device.has_power)
                if is_powered and device is not self._homing:
                    return f"'{device.name}' is {state} without a request. {device.health().text}".rstrip()
            return ""
        allowed = _ALLOWED[self.mode] if self.act is not Act.IDLE else _ALLOWED_IDLE
        for device, state in zip(self._actuators.devices, states, strict=True):
            if state not in allowed:
                return f"'{device.name}' is {state} while the robot is in mode '{self.mode}'. {device.health().text}"
        return ""

    def _enabling(self, now: float, states: list[DeviceState], has_command: bool, is_parked: bool) -> None:
        if all(state is DeviceState.ENABLED for state in states):
            self.mode, self._deadline = Mode.HOLD, now + self._hold
        elif now > self._deadline:
            late = self._actuators.names_not_in(DeviceState.ENABLED, states)
            self.fault(
                f"Not enabled within {self._enable_timeout:g} s: {late}. Is the motor supply on? If a brake or "
                "precharge takes longer, set command.enable_timeout."
            )

    def _holding(self, now: float, states: list[DeviceState], has_command: bool, is_parked: bool) -> None:
        if has_command:
            self.mode = Mode.FOLLOW
        elif now > self._deadline:
            if self._stop_act is Act.HOLD:
                self._release(now, self._actuators.disable)
            else:
                self._begin_stop(now)

    def _following(self, now: float, states: list[DeviceState], has_command: bool, is_parked: bool) -> None:
        if not has_command:
            self.mode, self._deadline = Mode.HOLD, now + self._hold

    def _stopping(self, now: float, states: list[DeviceState], has_command: bool, is_parked: bool) -> None:
        if self._act is Act.PARK:
            self._park(now, is_parked)
        elif self._act is not Act.IDLE:
            if now > self._deadline:
                self._release(now, self._actuators.disable)
        elif all(state is DeviceState.READY for state in states):
            self.mode, self._homing = Mode.OFF, None
        elif now > self._deadline:
            late = self._actuators.names_not_in(DeviceState.READY, states)
            self.fault(f"Still enabled {DISABLE_TIMEOUT:g} s after being disabled: {late}. Cut the power.")

    def _park(self, now: float, is_parked: bool) -> None:
        if not is_parked:
            self._parked_at = None
            if now > self._deadline:
                self.fault(f"The robot was not parked within {self._park_time:g} s. Is its motion blocked?")
            return
        if self._parked_at is None:
            self._parked_at = now
        if now >= self._parked_at + PARK_SETTLE:
            self._release(now, self._actuators.disable)

    def _find_zero(self, now: float, states: list[DeviceState], has_command: bool, is_parked: bool) -> None:
        device = self._homing
        assert device is not None
        health = device.health()
        if health.state is DeviceState.HOMING and now <= self._deadline:
            self._homing_seen = True
        elif health.state is DeviceState.HOMING:
            self.fault(f"'{device.name}' has not found its zero within {HOMING_TIMEOUT:g} s.")
        elif health.state is DeviceState.READY and self._homing_seen and not health.text:
            self.mode, self._homing = Mode.OFF, None
        elif health.state is not DeviceState.READY or self._homing_seen:
            self.fault(f"'{device.name}' is {health.state} without having found its zero. {health.text}".rstrip())
        elif now > self._deadline - HOMING_TIMEOUT + self._enable_timeout:
            self.fault(f"'{device.name}' has not started its homing. {health.text}".rstrip())


_POWERED = (DeviceState.ENABLED, DeviceState.HOMING)
_ALLOWED_IDLE = (DeviceState.ENABLED, DeviceState.HOMING, DeviceState.STOPPING, DeviceState.READY)
_ALLOWED = {
    Mode.ENABLING: (DeviceState.ENABLED, DeviceState.READY),
    Mode.HOLD: (DeviceState.ENABLED,),
    Mode.FOLLOW: (DeviceState.ENABLED,),
    Mode.STOPPING: (DeviceState.ENABLED,),
}
_STEPS: dict[Mode, Callable[[ModeMachine, float, list[DeviceState], bool, bool], None]] = {
    Mode.ENABLING: ModeMachine._enabling,
    Mode.HOLD: ModeMachine._holding,
    Mode.FOLLOW: ModeMachine._following,
    Mode.HOMING: ModeMachine._find_zero,
    Mode.STOPPING: ModeMachine._stopping,
}


def _park_time(config: RobotConfig) -> float:
    """Return the time limit [s] of parking: twice the time for the longest way within the ranges, and 5 s."""
    if config.stop.park is None or config.stop.speed is None:
        return 0.0
    low, high = config.bounds(config.command.signal)
    longest = float((high - low).max())
    return 60.0 if longest == float("inf") else 5.0 + 2.0 * longest / config.stop.speed
