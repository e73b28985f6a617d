"""What a robot file says of a node with a DBC file: which signals mean what, and what is sent when."""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from hal.config import Finite, Positive, Section
from hal.drivers.can_device import DeviceSettings


def _no_switch(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("YAML takes ON, OFF, YES and NO for true and false: put the name in quotes.")
    return value


Value = Annotated[float | str, BeforeValidator(_no_switch)]

Byte = Annotated[int, Field(ge=0, le=255)]
Identifier = Annotated[int, Field(ge=0, lt=1 << 29)]


def _not_zero(value: float) -> float:
    if value == 0.0:
        raise ValueError("a factor must not be 0.")
    return value


Factor = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_not_zero)]

MOTION = ("position", "velocity", "effort")
"""Quantities whose sign `direction` turns, and which can be commanded."""


class QuantityConfig(Section):
    """How a quantity follows from a signal: offset + scale * what the DBC file makes of the frame."""

    signal: str
    """`Message.Signal`."""
    scale: Factor = 1.0
    """SI units per unit of the DBC file."""
    offset: Finite = 0.0
    """SI units at zero."""


class FrameConfig(Section):
    """A frame that the DBC file does not describe."""

    id: Identifier
    data: Annotated[tuple[Byte, ...], Field(max_length=8)] = ()
    remote: bool = False
    """A remote frame, which asks for the data frame of this identifier."""
    broadcast: bool = False
    """The identifier is as it is on the bus, without anything added for the node."""


class ConditionConfig(Section):
    """What a signal is waited to say."""

    signal: str
    """`Message.Signal`."""
    equals: Value | None = None
    """A number in the unit of the DBC file, or one of the names that the file gives to values."""
    one_of: tuple[Value, ...] = ()
    below: Positive | None = None
    """Bound of the magnitude, in the unit of the DBC file."""

    @model_validator(mode="after")
    def _is_one_question(self) -> Self:
        if [self.equals is not None, bool(self.one_of), self.below is not None].count(True) != 1:
            raise ValueError("a condition has either `equals`, or `one_of`, or `below`.")
        return self


class UntilConfig(ConditionConfig):
    """A condition, and how long it may take; a frame that came before the step does not count."""

    within: Positive = 0.5
    """[s]."""


class StepConfig(Section):
    """One step of a sequence: something to send, something to wait for, or both."""

    send: str | None = None
    """A message of the DBC file."""
    values: dict[str, Value] = Field(default_factory=dict)
    """Its signals; one that is not named has the file's start value, or else a raw 0."""
    frame: FrameConfig | None = None
    """In place of `send`."""
    until: UntilConfig | None = None
    unless: ConditionConfig | None = None
    """The step is left out if this is so already."""

    @model_validator(mode="after")
    def _does_something(self) -> Self:
        if self.send is not None and self.frame is not None:
            raise ValueError("a step has either `send` or `frame`, not both.")
        if self.send is None and self.frame is None and self.until is None:
            raise ValueError("a step needs `send`, `frame` or `until`.")
        if self.values and self.send is None:
            raise ValueError("`values` are those of the message in `send`.")
        return self


Steps = tuple[StepConfig, ...]


class ErrorConfig(Section):
    """The signal that says what is wrong."""

    signal: str
    """`Message.Signal`."""
    good: Value = 0.0
    """What it says when nothing is wrong."""
    bits: bool = False
    """Each bit is an error of its own."""


class HeartbeatConfig(Section):
    """The message that the device sends as long as it lives."""

    message: str
    timeout: Positive
    """[s]."""


class IdentityConfig(Section):
    """How the device tells which one it is."""

    ask: StepConfig | None = None
    signals: Annotated[tuple[str, ...], Field(min_length=1)]
    """`Message.Signal`s that together differ between any two devices; all of one message."""


class StateConfig(Section):
    """The signal that tells where a servo stands, and which of its values mean what."""

    signal: str
    """`Message.Signal`."""
    ready: Annotated[tuple[Value, ...], Field(min_length=1)]
    enabled: Annotated[tuple[Value, ...], Field(min_length=1)]
    busy: tuple[Value, ...] = ()
    """It does something by itself, such as to calibrate or to find its zero."""
    fault: tuple[Value, ...] = ()
    booting: tuple[Value, ...] = ()
    """It has lost what it was told; it is opened anew."""
    reason: str | None = None
    """`Message.Signal` that tells why it does not do what it was asked."""


class CommandConfig(Section):
    """The set-point, sent in every cycle."""

    quantity: Literal["position", "velocity", "effort"]
    send: str
    """A message of the DBC file."""
    signal: str
    """The signal in it that takes the set-point."""
    scale: Factor | None = None
    """SI units per unit of the DBC file; absent: that of the quantity."""
    offset: Finite | None = None
    """SI units at zero; absent: that of the quantity."""
    values: dict[str, Value] = Field(default_factory=dict)
    """The other signals of the message."""
    while_disabled: bool = False
    """Also sent while the servo is not enabled: where it is, or 0 for a velocity or an effort. Not for a servo that is
    started by it."""


class WatchdogConfig(Section):
    """The servo's own watch over the host: what it does nobody else can do when the host dies."""

    timeout: Positive
    """The servo stops by itself after so long [s] without being fed."""
    fed_by: Annotated[tuple[str, ...], Field(min_length=1)]
    """Messages that feed it; at least one is sent in every cycle."""
    configure: Steps = ()
    """Sent when the servo is opened, to set it up; empty if it keeps that itself."""
    expired: ConditionConfig | None = None
    """How the servo tells that it ran out; told while the servo was disabled, it is no fault and is reset."""


class DbcSettings(DeviceSettings):
    """Settings of whatever measures and has a DBC file."""

    dbc: Path
    """The DBC file; relative to the folder of the robot file."""
    node_offset: Annotated[int, Field(ge=0)] = 0
    """Identifier on the bus = identifier in the file + node id * this; 0 if the file is of one very node."""
    extended: bool | None = None
    """Whether identifiers have 29 bits; absent: as the file says of each message."""
    quantities: Annotated[dict[str, QuantityConfig], Field(min_length=1)]
    """What it measures; what it is there for comes first."""
    periods: Annotated[dict[str, Positive | Literal["cycle"]], Field(min_length=1)]
    """Period [s] of every message that it sends by itself; `cycle` for one with which it answers each cycle's frame."""
    direction: Literal[1, -1] = 1
    """-1 if position, velocity and effort grow the other way."""
    zero: Finite = 0.0
    """Added to the position, or to what a sensor is there for [SI unit]."""
    gain: Factor = 1.0
    """What a sensor is there for is multiplied by it before `zero` is added."""
    heartbeat: HeartbeatConfig | None = None
    error: ErrorConfig | None = None
    """Of a servo: a fault. Of a sensor: its values are not valid."""
    identity: IdentityConfig | None = None
    open: Steps = ()
    """Sent when it is opened."""
    tare: Steps = ()
    """Sent to have a sensor take what it measures as zero."""

    @model_validator(mode="after")
    def _tares_at_once(self) -> Self:
        if any(step.until for step in self.tare):
            raise ValueError("tare is sent at once and waits for nothing: drop its `until`.")
        return self


class ServoSettings(DbcSettings):
    """Settings of a servo with a DBC file. No frame of it enables but those of `enable`."""

    command: CommandConfig
    damping: Positive | None = None
    """Of an effort command: what `damp` resists with [N m s/rad or N s/m]."""
    cyclic: Steps = ()
    """Sent in every cycle beside the set-point."""
    state: StateConfig
    enable: Annotated[Steps, Field(min_length=1)]
    """Until its last step is sent the set-point is where the servo is; then it stays, until the servo is enabled."""
    disable: Annotated[Steps, Field(min_length=1)]
    quick_stop: Steps = ()
    """Absent: as `disable`."""
    reset: Steps = ()
    """Leaves a fault; never enables."""
    watchdog: WatchdogConfig | None = None
    allow_no_watchdog: bool = False
    """The servo may go on for ever with its last set-point when the host dies."""

    @model_validator(mode="after")
    def _stops_without_us(self) -> Self:
        if self.command.quantity not in self.quantities:
            raise ValueError(
                f"command.quantity '{self.command.quantity}' is not measured. Add it to quantities: "
                "a servo starts from where it is."
            )
        if self.damping is not None and self.command.quantity != "effort":
            raise ValueError(f"damping needs an effort to be commanded, not a {self.command.quantity}.")
        if self.watchdog is None:
            if not self.allow_no_watchdog:
                raise ValueError(
                    "a DBC file has no watchdog. Say in `watchdog` which frames feed the servo's own and its timeout, "
                    "or `allow_no_watchdog: true` if it may go on with its last set-point when the host dies."
                )
            return self
        sent = {self.command.send, *(step.send for step in self.cyclic)}
        if not sent & set(self.watchdog.fed_by):
            raise ValueError(
                f"watchdog.fed_by names {', '.join(self.watchdog.fed_by)}, of which none is sent in every cycle. "
                f"Sent are {', '.join(sorted(filter(None, sent)))}."
            )
        return self

    @model_validator(mode="after")
    def _cycles_at_once(self) -> Self:
        if any(step.until for step in self.cyclic):
            raise ValueError("what is sent in every cycle waits for nothing: drop the `until` of `cyclic`.")
        return self
