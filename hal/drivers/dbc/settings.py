"""Settings of a node with a DBC file: the meaning of its signals, and the frames sent to it."""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from hal.config import Finite, Positive, Section
from hal.drivers.can_device import DeviceSettings


def _refuse_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("YAML reads ON, OFF, YES and NO as true and false: put the name in quotes.")
    return value


Value = Annotated[float | str, BeforeValidator(_refuse_bool)]

Byte = Annotated[int, Field(ge=0, le=255)]
Identifier = Annotated[int, Field(ge=0, lt=1 << 29)]


def _refuse_zero(value: float) -> float:
    if value == 0.0:
        raise ValueError("a factor must not be 0.")
    return value


Factor = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_refuse_zero)]

MOTION = ("position", "velocity", "effort")
"""These quantities can be commanded, and `direction` changes their sign."""


class QuantityConfig(Section):
    """The conversion of a signal to a quantity: offset + scale * value in the unit of the DBC file."""

    signal: str
    """`Message.Signal`."""
    scale: Factor = 1.0
    """SI units per unit of the DBC file."""
    offset: Finite = 0.0
    """Value of the quantity [SI] at signal value 0."""


class FrameConfig(Section):
    """A frame that is not in the DBC file."""

    id: Identifier
    data: Annotated[tuple[Byte, ...], Field(max_length=8)] = ()
    remote: bool = False
    """Whether it is a remote frame, which requests the data frame of this identifier."""
    broadcast: bool = False
    """Whether `id` is the identifier on the bus, to which no node id is added."""


class ConditionConfig(Section):
    """A condition on the value of a signal."""

    signal: str
    """`Message.Signal`."""
    equals: Value | None = None
    """A number in the unit of the DBC file, or the name of a value in the file."""
    one_of: tuple[Value, ...] = ()
    below: Positive | None = None
    """Upper bound of the magnitude, in the unit of the DBC file."""

    @model_validator(mode="after")
    def _has_one_criterion(self) -> Self:
        if [self.equals is not None, bool(self.one_of), self.below is not None].count(True) != 1:
            raise ValueError("a condition has either `equals`, or `one_of`, or `below`.")
        return self


class UntilConfig(ConditionConfig):
    """A condition with a time limit; a frame received before the step does not count."""

    within: Positive = 0.5
    """Time limit [s]."""


class StepConfig(Section):
    """One step of a sequence: something to send, something to wait for, or both."""

    send: str | None = None
    """A message of the DBC file."""
    values: dict[str, Value] = Field(default_factory=dict)
    """Its signals. A signal without a value has the file's start value, or else raw 0."""
    frame: FrameConfig | None = None
    """A frame in place of `send`."""
    until: UntilConfig | None = None
    unless: ConditionConfig | None = None
    """The step is skipped if this condition holds."""

    @model_validator(mode="after")
    def _has_an_action(self) -> Self:
        if self.send is not None and self.frame is not None:
            raise ValueError("a step has either `send` or `frame`, not both.")
        if self.send is None and self.frame is None and self.until is None:
            raise ValueError("a step needs `send`, `frame` or `until`.")
        if self.values and self.send is None:
            raise ValueError("`values` are those of the message in `send`.")
        return self


Steps = tuple[StepConfig, ...]


class ErrorConfig(Section):
    """The signal that reports errors."""

    signal: str
    """`Message.Signal`."""
    good: Value = 0.0
    """Its value without an error."""
    bits: bool = False
    """Whether each bit is an error of its own."""


class HeartbeatConfig(Section):
    """The heartbeat message of the device."""

    message: str
    timeout: Positive
    """The device is silent after this time [s] without a heartbeat."""


class IdentityConfig(Section):
    """The signals that identify the device."""

    ask: StepConfig | None = None
    """Request for these signals."""
    signals: Annotated[tuple[str, ...], Field(min_length=1)]
    """`Message.Signal`s whose values together are unique to a device; all in one message."""


class StateConfig(Section):
    """The signal with the state of a servo, and the meaning of its values."""

    signal: str
    """`Message.Signal`."""
    ready: Annotated[tuple[Value, ...], Field(min_length=1)]
    enabled: Annotated[tuple[Value, ...], Field(min_length=1)]
    busy: tuple[Value, ...] = ()
    """The servo runs a procedure of its own, such as calibration or homing."""
    fault: tuple[Value, ...] = ()
    booting: tuple[Value, ...] = ()
    """The servo has lost its configuration and is opened again."""
    reason: str | None = None
    """`Message.Signal` with the reason why a request failed."""


class CommandConfig(Section):
    """The set-point, sent in every cycle."""

    quantity: Literal["position", "velocity", "effort"]
    send: str
    """A message of the DBC file."""
    signal: str
    """The signal of this message that carries the set-point."""
    scale: Factor | None = None
    """SI units per unit of the DBC file; absent: that of the quantity."""
    offset: Finite | None = None
    """Set-point [SI] at signal value 0; absent: that of the quantity."""
    values: dict[str, Value] = Field(default_factory=dict)
    """The other signals of the message."""
    while_disabled: bool = False
    """Whether a set-point is also sent while the servo is disabled: its position, or 0 for a velocity or an effort.
    Not for a servo that starts to move when it receives a set-point."""


class WatchdogConfig(Section):
    """The watchdog in the servo, which stops the servo when the host dies."""

    timeout: Positive
    """The servo stops by itself after this time [s] without a message that feeds the watchdog."""
    fed_by: Annotated[tuple[str, ...], Field(min_length=1)]
    """Messages that feed it; at least one is sent in every cycle."""
    configure: Steps = ()
    """Sent on opening to configure the watchdog; empty if the servo stores this configuration."""
    expired: ConditionConfig | None = None
    """The servo reports that the watchdog ran out. While the servo is disabled this is not a fault and is reset."""


class DbcSettings(DeviceSettings):
    """Settings of a sensor with a DBC file."""

    dbc: Path
    """The DBC file; relative to the folder of the robot file."""
    node_offset: Annotated[int, Field(ge=0)] = 0
    """Identifier on the bus = identifier in the file + node id * this; 0 if the file describes a single node."""
    extended: bool | None = None
    """Whether identifiers have 29 bits; absent: as in the DBC file."""
    quantities: Annotated[dict[str, QuantityConfig], Field(min_length=1)]
    """Measured quantities, the main quantity first."""
    periods: Annotated[dict[str, Positive | Literal["cycle"]], Field(min_length=1)]
    """Period [s] of every message that the device sends by itself; `cycle` if it answers the frame of each cycle."""
    direction: Literal[1, -1] = 1
    """-1 reverses position, velocity and effort."""
    zero: Finite = 0.0
    """Added to the position, or to the main quantity of a sensor [SI unit]."""
    gain: Factor = 1.0
    """Factor of the main quantity of a sensor, applied before `zero` is added."""
    heartbeat: HeartbeatConfig | None = None
    error: ErrorConfig | None = None
    """An error is a fault of a servo; the values of a sensor are invalid."""
    identity: IdentityConfig | None = None
    open: Steps = ()
    """Sent on opening."""
    tare: Steps = ()
    """Sent so that a sensor takes its present value as zero."""

    @model_validator(mode="after")
    def _tares_at_once(self) -> Self:
        if any(step.until for step in self.tare):
            raise ValueError("tare is sent at once and cannot wait: remove its `until`.")
        return self


class ServoSettings(DbcSettings):
    """Settings of a servo with a DBC file. Only the frames of `enable` may enable it."""

    command: CommandConfig
    damping: Positive | None = None
    """Damping of `damp` [N m s/rad or N s/m]; only with an effort command."""
    cyclic: Steps = ()
    """Sent in every cycle beside the set-point."""
    state: StateConfig
    enable: Annotated[Steps, Field(min_length=1)]
    """Until its last step is sent the set-point follows the measured position; then it is held until the servo is
    enabled."""
    disable: Annotated[Steps, Field(min_length=1)]
    quick_stop: Steps = ()
    """Absent: as `disable`."""
    reset: Steps = ()
    """Leaves a fault; never enables."""
    watchdog: WatchdogConfig | None = None
    allow_no_watchdog: bool = False
    """Accept a servo that goes on with its last set-point for ever when the host dies."""

    @model_validator(mode="after")
    def _check_command_and_watchdog(self) -> Self:
        if self.command.quantity not in self.quantities:
            raise ValueError(
                f"command.quantity '{self.command.quantity}' is not measured. Add it to quantities: "
                "a servo starts from its measured value."
            )
        if self.damping is not None and self.command.quantity != "effort":
            raise ValueError(f"damping needs an effort command, not a {self.command.quantity} command.")
        if self.watchdog is None:
            if not self.allow_no_watchdog:
                raise ValueError(
                    "a DBC file has no watchdog. Give timeout and frames of the servo's own watchdog in `watchdog`, or "
                    "set `allow_no_watchdog: true` if it may go on with its last set-point when the host dies."
                )
            return self
        sent = {self.command.send, *(step.send for step in self.cyclic)}
        if not sent & set(self.watchdog.fed_by):
            raise ValueError(
                f"watchdog.fed_by has {', '.join(self.watchdog.fed_by)}, but none of them is sent in every cycle. "
                f"Sent in every cycle: {', '.join(sorted(filter(None, sent)))}."
            )
        return self

    @model_validator(mode="after")
    def _cycles_at_once(self) -> Self:
        if any(step.until for step in self.cyclic):
            raise ValueError("`cyclic` is sent in every cycle and cannot wait: remove its `until`.")
        return self
