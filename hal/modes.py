"""What the robot is doing, and what may happen next: off, enabling, hold, follow, stopping, fault."""

from collections.abc import Callable, Sequence
from enum import StrEnum

from hal.config import CommandConfig
from hal.device import Device, DeviceState
from hal.errors import CommandRefused

ENABLE_TIMEOUT = 2.0
"""How long [s] all drives together may take to enable; a brake needs some 0.1 s."""
DISABLE_TIMEOUT = 1.0
"""How long [s] they may take to let go."""


class Mode(StrEnum):
    """What the robot is doing as a whole; the drives of a muscle arm must not be left to do different things."""

    OFF = "off"
    ENABLING = "enabling"
    HOLD = "hold"
    """Enabled; the set-point stays where it is."""
    FOLLOW = "follow"
    """Enabled; a command younger than its time to live is followed."""
    STOPPING = "stopping"
    """Holding for the last time, or waiting for the drives to let go; takes no commands."""
    FAULT = "fault"
    """Disabled because something is wrong; left by `reset` only."""


class ModeMachine:
    """The mode, its deadlines, and the one sentence that says why there is a fault. Not thread safe."""

    def __init__(self, actuators: Sequence[Device], command: CommandConfig) -> None:
        self._actuators = tuple(actuators)
        self._hold = command.hold
        self._deadline = 0.0
        self._letting_go = False
        self.mode = Mode.OFF
        self.fault_text = ""

    @property
    def powered(self) -> bool:
        """Whether set-points are sent."""
        return self.mode in (Mode.FOLLOW, Mode.HOLD, Mode.ENABLING) or (
            self.mode is Mode.STOPPING and not self._letting_go
        )

    @property
    def takes_commands(self) -> bool:
        """Whether a command may be given now."""
        return self.mode is Mode.FOLLOW or self.mode is Mode.HOLD

    def enable(self, now: float) -> None:
        """Ask all drives to hold where they are.

        Raises:
            CommandRefused: In fault, stopping, or a drive is not ready.
        """
        if self.mode in (Mode.HOLD, Mode.FOLLOW, Mode.ENABLING):
            return
        if self.mode is Mode.FAULT:
            raise CommandRefused(f"The robot is in fault: {self.fault_text} Reset it first.")
        if self.mode is Mode.STOPPING:
            raise CommandRefused("The robot is still stopping. Enable it when its mode is 'off'.")
        if not self._actuators:
            raise CommandRefused("The robot has no device that can be commanded.")
        for device in self._actuators:
            health = device.health()
            if health.state is not DeviceState.READY:
                raise CommandRefused(
                    f"'{device.name}' is {health.state}, not ready, so nothing was enabled. {health.text}".rstrip()
                )
        for device in self._actuators:
            device.enable()
        self.mode = Mode.ENABLING
        self._deadline = now + ENABLE_TIMEOUT

    def disable(self, now: float) -> None:
        """Let go at once."""
        if self.mode in (Mode.OFF, Mode.FAULT):
            return
        for device in self._actuators:
            device.disable()
        self.mode, self._letting_go, self._deadline = Mode.STOPPING, True, now + DISABLE_TIMEOUT

    def stop(self, now: float) -> None:
        """Hold at once, and let go when the robot file's `command.hold` is over."""
        if self.mode in (Mode.HOLD, Mode.FOLLOW):
            self.mode, self._letting_go, self._deadline = Mode.STOPPING, False, now + self._hold
        elif self.mode is Mode.ENABLING:
            self.disable(now)

    def fault(self, text: str) -> None:
        """Disable everything and stay so until `reset`; the first cause is the one that is told."""
        for device in self._actuators:
            device.disable()
        if self.mode is not Mode.FAULT:
            self.mode, self.fault_text = Mode.FAULT, text

    def reset(self) -> None:
        """Leave the fault; enables nothing.

        Raises:
            CommandRefused: The robot is enabled.
        """
        if self.mode not in (Mode.OFF, Mode.FAULT):
            raise CommandRefused(f"The robot is in mode '{self.mode}', there is no fault to reset.")
        self.mode, self.fault_text = Mode.OFF, ""

    def step(self, now: float, has_command: bool) -> None:
        """Move on to the mode of this cycle; `has_command` says whether an accepted command is still alive."""
        if self.mode in (Mode.OFF, Mode.FAULT):
            return
        states = [device.health().state for device in self._actuators]
        problem = self._problem(states)
        if problem:
            self.fault(problem)
            return
        _STEPS[self.mode](self, now, states, has_command)

    def _problem(self, states: list[DeviceState]) -> str:
        """Why the group must stop, given the drives' states; empty if it need not."""
        may_be_ready = self.mode is Mode.ENABLING or (self.mode is Mode.STOPPING and self._letting_go)
        for device, state in zip(self._actuators, states, strict=True):
            if state is not DeviceState.ENABLED and not (may_be_ready and state is DeviceState.READY):
                return f"'{device.name}' is {state} while the robot is in mode '{self.mode}'. {device.health().text}"
        return ""

    def _enabling(self, now: float, states: list[DeviceState], has_command: bool) -> None:
        if all(state is DeviceState.ENABLED for state in states):
            self.mode, self._deadline = Mode.HOLD, now + self._hold
        elif now > self._deadline:
            late = [d.name for d, s in zip(self._actuators, states, strict=True) if s is not DeviceState.ENABLED]
            self.fault(f"Not enabled within {ENABLE_TIMEOUT:g} s: {', '.join(late)}. Is the motor supply on?")

    def _holding(self, now: float, states: list[DeviceState], has_command: bool) -> None:
        if has_command:
            self.mode = Mode.FOLLOW
        elif now > self._deadline:
            self.disable(now)

    def _following(self, now: float, states: list[DeviceState], has_command: bool) -> None:
        if not has_command:
            self.mode, self._deadline = Mode.HOLD, now + self._hold

    def _stopping(self, now: float, states: list[DeviceState], has_command: bool) -> None:
        if not self._letting_go:
            if now > self._deadline:
                self.disable(now)
        elif all(state is DeviceState.READY for state in states):
            self.mode = Mode.OFF
        elif now > self._deadline:
            held = [d.name for d, s in zip(self._actuators, states, strict=True) if s is not DeviceState.READY]
            self.fault(f"Still enabled {DISABLE_TIMEOUT:g} s after being disabled: {', '.join(held)}. Cut the power.")


_STEPS: dict[Mode, Callable[[ModeMachine, float, list[DeviceState], bool], None]] = {
    Mode.ENABLING: ModeMachine._enabling,
    Mode.HOLD: ModeMachine._holding,
    Mode.FOLLOW: ModeMachine._following,
    Mode.STOPPING: ModeMachine._stopping,
}
