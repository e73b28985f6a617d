"""Typed models of a robot file (robots/*.yaml). An unknown key is an error that lists the known keys."""

import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from hal.bounds_config import (
    Above0,
    Finite,
    LimitConfig,
    NumbersConfig,
    PlausibleConfig,
    Positive,
    RangeConfig,
    Rate,
    Section,
    per_element,
)
from hal.calibration.units import check_robot_unit
from hal.errors import ConfigError
from hal.reading.mistakes import explain, parse_yaml, yaml_problem

__all__ = [
    "BusConfig",
    "CommandConfig",
    "ComputedConfig",
    "DeviceConfig",
    "Finite",
    "KindConfig",
    "LimitConfig",
    "PlausibleConfig",
    "Positive",
    "RangeConfig",
    "Rate",
    "RatesConfig",
    "RobotConfig",
    "Section",
    "SignalConfig",
    "StopConfig",
    "explain",
    "load_robot",
    "per_element",
]


class CommandConfig(Section):
    """Commanded signal, lifetime of a command, and behaviour without commands."""

    signal: str
    time_to_live: Annotated[float, Field(gt=0, le=10)] = 0.1
    """A command is followed up to this age [s]."""
    hold: Annotated[float, Field(ge=0)] = 1.0
    """The last applied command is held for this time [s] before the robot stops; a stop holds or damps as long."""
    enable_timeout: Annotated[float, Field(gt=0, le=60)] = 2.0
    """The drives together may take this time [s] to enable, with their brakes and precharges."""
    following_error: Above0 | tuple[Above0, ...] | None = None
    """Largest difference between set-points and measurement [unit of the commanded signal]; beyond it the robot stops.
    Default: a part of the range."""
    following_lag: Annotated[float, Field(gt=0, le=5)] = 0.25
    """A drive is where a set-point of this last time [s] was."""
    topic: str = ""
    """Topic of ROS 2 on which set-points are published, of a robot whose drivers are ROS 2 nodes; without it such a
    robot is only measured."""
    message: Literal["JointTrajectory", "Float64MultiArray"] = "JointTrajectory"
    """Type of the messages on this topic."""


class StopConfig(NumbersConfig):
    """Behaviour of the robot when it is asked to stop, or when commands end."""

    behaviour: Literal["hold", "damp", "park", "off"] = "hold"
    """The drives lose power after `command.hold` seconds in which they `hold` their position or `damp` their motion,
    after a slow motion to a safe posture (`park`), or at once (`off`)."""
    park: tuple[Finite, ...] | None = None
    """Safe posture [unit of the commanded signal]."""
    speed: Positive | None = None
    """Highest speed of the motion to the safe posture [unit/s]."""

    @model_validator(mode="after")
    def _says_where(self) -> "StopConfig":
        parks = self.behaviour == "park"
        if parks and (self.park is None or self.speed is None):
            raise ValueError("the behaviour park needs a posture (`park`, a value per element) and a `speed`.")
        if not parks and (self.park is not None or self.speed is not None):
            raise ValueError(f"`park` and `speed` are for the behaviour park, not for '{self.behaviour}'.")
        return self


class ComputedConfig(Section):
    """Computation of a signal from another one of the same sample."""

    by: str
    """`module:name` of a function: (values, **settings) -> the signal's values."""
    inputs: str = Field(alias="from")
    """Name of the input signal."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Arguments of the function; lists become arrays."""


class SignalConfig(Section):
    """A named vector of sensor or control values."""

    unit: str
    """SI unit of its values, one of `hal.calibration.units.ROBOT_UNITS`."""
    elements: tuple[str, ...] = Field(min_length=1)
    stale_after: Positive = 0.02
    """An element is valid up to this age [s]."""
    source: Literal["hal", "vision", "ros2"] = "hal"
    """Publisher of the signal: the HAL, the process of a camera, or nodes of ROS 2."""
    topic: str = ""
    """Topic of ROS 2 that has the signal."""
    field: str = ""
    """Field of the messages on this topic (`position`, `data`, `force`); it says their type too."""
    computed: ComputedConfig | None = None
    """Computation by the HAL; None for a signal that devices measure."""
    plausible: PlausibleConfig | None = None
    """Physically possible measurements; what is not given follows from the limits."""

    @field_validator("unit", mode="before")
    @classmethod
    def _is_unit(cls, unit: object) -> str:
        text = str(unit or "")  # `unit: 1` is a number in YAML
        check_robot_unit(text)
        return text

    @field_validator("plausible")
    @classmethod
    def _plausible_in_unit(cls, plausible: PlausibleConfig | None, info: ValidationInfo) -> PlausibleConfig | None:
        unit = info.data.get("unit")
        return plausible.in_unit(unit, "plausible") if plausible and unit else plausible

    @model_validator(mode="after")
    def _topic_fits(self) -> "SignalConfig":
        if (self.source == "ros2") != bool(self.topic.startswith("/") and self.field):
            raise ValueError(
                "a signal with `source: ros2`, and only that, has the full name of its `topic` (/joint_states) and a "
                "`field` (position)."
            )
        return self

    @property
    def size(self) -> int:
        """Number of elements."""
        return len(self.elements)


class BusConfig(Section):
    """One CAN bus, in the terms of python-can."""

    interface: str = "socketcan"
    channel: str
    bitrate: int = 1_000_000
    data_bitrate: Annotated[int, Field(gt=0)] | None = None
    """Bit rate of the data of CAN FD frames [bit/s]; without it the bus carries classic frames only."""
    max_load: Annotated[float, Field(gt=0, le=0.8)] = 0.6
    """Largest share of the bit rate for the cyclic frames; the HAL does not start with more."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Arguments for python-can."""

    @property
    def is_fd(self) -> bool:
        """Whether the bus carries frames of CAN FD too."""
        return self.data_bitrate is not None

    @model_validator(mode="after")
    def _data_is_not_slower(self) -> "BusConfig":
        if self.data_bitrate is not None and self.data_bitrate < self.bitrate:
            raise ValueError(
                f"data_bitrate is {self.data_bitrate}, below bitrate, {self.bitrate}: the data of CAN FD frames are "
                "sent at the same bit rate or a higher one."
            )
        return self


class KindConfig(Section):
    """Driver and settings that several devices share."""

    driver: str
    settings: dict[str, Any] = Field(default_factory=dict)


class DeviceConfig(Section):
    """One device on a bus: its address, and the elements that it measures or moves."""

    kind: str
    bus: str
    node: Annotated[int, Field(ge=0, le=2047)]
    element: str | None = None
    """`signal.element` of its main quantity, as in `muscle_length.biceps`."""
    elements: dict[str, str] = Field(default_factory=dict)
    """Quantity of the driver -> `signal.element`, as in `velocity: joint_velocity.elbow`; replaces `element`."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings that are added to those of the kind; a key in both takes the device's value."""

    @model_validator(mode="after")
    def _serves_something(self) -> "DeviceConfig":
        if (self.element is None) == (not self.elements):
            raise ValueError("a device has either `element`, or `elements` with at least one quantity.")
        return self

    @property
    def served(self) -> tuple[str, ...]:
        """Every `signal.element` that the device measures or moves."""
        return tuple(self.elements.values()) if self.element is None else (self.element,)


class RatesConfig(Section):
    """Loop rates [Hz]."""

    hal: Rate = 200.0
    estimation: Rate = 200.0
    control: Rate = 50.0
    anomaly: Rate = 100.0
    update: Rate = 10.0


Via = tuple[str, Finite, Finite, Finite]
"""A point of a wire is a link of the URDF and a place in its frame [m]."""


class RobotConfig(Section):
    """A whole robot file."""

    robot: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    description: str = ""
    signals: dict[str, SignalConfig] = Field(min_length=1)
    command: CommandConfig
    limits: dict[str, LimitConfig] = Field(default_factory=dict)
    stop: StopConfig = StopConfig()
    rates: RatesConfig = RatesConfig()
    buses: dict[str, BusConfig] = Field(default_factory=dict)
    kinds: dict[str, KindConfig] = Field(default_factory=dict)
    devices: dict[str, DeviceConfig] = Field(default_factory=dict)
    simulator: str | None = None
    """`module:name` of the simulator that replaces the hardware."""
    physics: Literal["bullet", "mujoco"] | None = None
    """Engine of that simulator; by default PyBullet if it is installed, else MuJoCo."""
    ros2: dict[str, Any] = Field(default_factory=dict)
    """Settings of the bridge to ROS 2, which checks this section itself."""
    urdf: Path | None = None
    """URDF file for the live page, relative to the robot file."""
    wires: dict[str, Annotated[tuple[Via, ...], Field(min_length=2)]] = Field(default_factory=dict)
    """Element of the tension signal -> points of its wire, which the live page draws."""
    tip: str | None = None
    """Link of the URDF whose place the camera of a simulator made from it sees."""
    conditions: tuple[str, ...] = ()
    """Known conditions of the body, such as the tools that it may hold; the first is the default."""
    model: dict[str, Any] = Field(default_factory=dict)
    """Settings of the body schema service, which checks this section itself."""
    collect: dict[str, Any] = Field(default_factory=dict)
    """Settings of random safe motion; the collector checks this section itself."""
    folder: Path = Path()
    """Folder of the robot file; paths in the file are relative to it."""

    @field_validator("limits")
    @classmethod
    def _limits_in_unit(cls, limits: dict[str, LimitConfig], info: ValidationInfo) -> dict[str, LimitConfig]:
        signals = info.data.get("signals", {})
        return {n: limit.in_unit(signals[n].unit, n) if n in signals else limit for n, limit in limits.items()}

    @field_validator("stop")
    @classmethod
    def _stop_in_unit(cls, stop: StopConfig, info: ValidationInfo) -> StopConfig:
        name, signals = getattr(info.data.get("command"), "signal", ""), info.data.get("signals", {})
        return stop.in_unit(signals[name].unit, name) if name in signals else stop

    @model_validator(mode="after")
    def _names_fit(self) -> "RobotConfig":
        signals = ", ".join(self.signals)
        if self.command.signal not in self.signals:
            raise ValueError(f"command.signal '{self.command.signal}' is not a signal. Known: {signals}.")
        if self.command.signal not in self.measured:
            raise ValueError(f"command.signal '{self.command.signal}' must be measured by devices, to start from it.")
        for name, signal in self.signals.items():
            twice = [element for element, count in Counter(signal.elements).items() if count > 1]
            if twice:
                raise ValueError(f"signals.{name}: element '{twice[0]}' is there twice. Give each a name of its own.")
            self._computed_fits(name)
            if signal.plausible is not None:
                signal.plausible.check(signal.size, f"signals.{name}.plausible")
                if name not in self.measured:
                    raise ValueError(f"signals.{name}.plausible: no device measures this signal. Check its inputs.")
        for name, limit in self.limits.items():
            if name not in self.signals:
                raise ValueError(f"limits.{name} is not a signal. Known: {signals}.")
            self._limits_fit(name, limit)
        self._park_fits()
        if len(set(self.conditions)) < len(self.conditions) or not all(self.conditions):
            raise ValueError(f"conditions must be names that differ, not {', '.join(map(repr, self.conditions))}.")
        addresses: dict[tuple[str, int], str] = {}
        elements: dict[str, str] = {}
        for name, device in self.devices.items():
            self._device_fits(name, device)
            taken = addresses.setdefault((device.bus, device.node), name)
            if taken != name:
                raise ValueError(f"devices '{taken}' and '{name}' both claim node {device.node} on bus '{device.bus}'.")
            for element in device.served:
                if element in elements:
                    raise ValueError(f"devices '{elements[element]}' and '{name}' both claim element '{element}'.")
                elements[element] = name
        if self.devices or self.has_topics:
            missing = [e for e in self.element_names(self._on_buses) if e not in elements]
            if missing:
                raise ValueError(
                    f"no device measures {', '.join(missing)}. Add one, remove the element, or set another `source`."
                )
        return self

    def _computed_fits(self, name: str) -> None:
        computed, source = self.signals[name].computed, self.signals[name].source
        if computed is None:
            return
        if source != "hal":
            raise ValueError(f"signals.{name} is computed by the HAL, so its source cannot be '{source}'.")
        if computed.inputs not in self.measured:
            raise ValueError(
                f"signals.{name}.computed.from '{computed.inputs}' is not a signal that devices measure. "
                f"Those are {', '.join(self.measured)}."
            )

    def _limits_fit(self, name: str, limit: LimitConfig) -> None:
        limit.check(self.signals[name].size, f"limits.{name}", name == self.command.signal)
        if name in self.seen and limit.is_watched:
            raise ValueError(f"limits.{name}: soft and trip limits are the HAL's, which does not see this signal.")

    def _park_fits(self) -> None:
        if self.stop.park is None:
            return
        signal = self.command.signal
        if len(self.stop.park) != self.signals[signal].size:
            raise ValueError(f"stop.park has {len(self.stop.park)} values, {signal} has {self.signals[signal].size}.")
        low, high = self.bounds(signal)
        for element, value, least, most in zip(self.signals[signal].elements, self.stop.park, low, high, strict=True):
            if not least <= value <= most:
                raise ValueError(f"stop.park: {element} {value:g} is outside of its limits, {least:g} to {most:g}.")

    def _device_fits(self, name: str, device: DeviceConfig) -> None:
        if device.kind not in self.kinds:
            raise ValueError(f"device '{name}' is of kind '{device.kind}'. Known kinds: {', '.join(self.kinds)}.")
        if device.bus not in self.buses:
            raise ValueError(f"device '{name}' is on bus '{device.bus}'. Known buses: {', '.join(self.buses)}.")
        known = self.element_names(self._on_buses)
        for element in device.served:
            if element not in known:
                which = "a device cannot measure" if element in self.element_names() else "no signal has"
                raise ValueError(
                    f"device '{name}' serves '{element}', which {which}. Known elements: {', '.join(known)}."
                )

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the signals that the HAL's devices measure; without a bus, nodes of ROS 2 are its devices."""
        return tuple(
            name
            for name, signal in self.signals.items()
            if signal.computed is None and (signal.source == "hal" or (signal.source == "ros2" and not self.buses))
        )

    @property
    def seen(self) -> tuple[str, ...]:
        """Names of the signals that another process than the HAL publishes: a camera, or the bridge to ROS 2."""
        return tuple(
            name
            for name, signal in self.signals.items()
            if signal.source == "vision" or (signal.source == "ros2" and self.buses)
        )

    @property
    def has_topics(self) -> bool:
        """Whether nodes of ROS 2 are the devices of the HAL."""
        return not self.buses and any(signal.source == "ros2" for signal in self.signals.values())

    @property
    def _on_buses(self) -> list[str]:
        return [name for name in self.measured if self.signals[name].source == "hal"]

    def element_names(self, signals: Iterable[str] | None = None) -> list[str]:
        """Return `signal.element` of every element of the given signals, or of all, in order."""
        names = self.signals if signals is None else signals
        return [f"{name}.{element}" for name in names for element in self.signals[name].elements]

    def bounds(self, signal: str) -> tuple[np.ndarray, np.ndarray]:
        """Return lowest and highest value of a signal [its unit], each of shape (n,); infinite where not stated."""
        limit = self.limits.get(signal, LimitConfig())
        return limit.bounds(self.signals[signal].size, f"limits.{signal}")

    def settings_of(self, device: str) -> dict[str, Any]:
        """Return the settings of the device's kind, replaced and extended by those of the device."""
        entry = self.devices[device]
        return {**self.kinds[entry.kind].settings, **entry.settings}


def load_robot(path: str | Path) -> RobotConfig:
    """Read a robot file.

    Raises:
        ConfigError: The file is missing, not YAML, or does not describe a robot.
    """
    path = Path(path)
    _check_kind(path)
    try:
        raw = parse_yaml(path.read_text())
    except FileNotFoundError:
        raise ConfigError(f"There is no robot file '{path}'. {_beside(path)}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"Robot file '{path}' cannot be read: {error}.") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"Robot file '{path}' is not YAML: {yaml_problem(error)}.") from None
    if not isinstance(raw, dict):
        raise ConfigError(f"Robot file '{path}' is empty or not a mapping. Compare it with robots/*.yaml.")
    folder = path.resolve().parent
    if str(folder) not in sys.path:
        sys.path.append(str(folder))  # simulators, drivers and motions of a user are modules beside the robot file
    try:
        return RobotConfig.model_validate({**raw, "folder": folder})
    except ValidationError as error:
        raise ConfigError(f"Robot file '{path}': {explain(error, RobotConfig)}") from None


def _check_kind(path: Path) -> None:
    """Refuse a folder, and a file that is something else by its name, before it is read as YAML."""
    if path.is_dir():
        raise ConfigError(
            f"'{path}' is a folder, not a robot file. `gemuco init {path}` drafts one from EDS and DBC files in it."
        )
    suffix = path.suffix.lower()
    if suffix in (".yaml", ".yml") or not path.exists():
        return
    if suffix in (".urdf", ".xml"):
        raise ConfigError(f"'{path}' is not a robot file. `gemuco init {path}` makes one of a URDF or MJCF file.")
    raise ConfigError(
        f"'{path}' is not a robot file, whose name ends in .yaml. robots/*.yaml are examples; `gemuco init` makes one."
    )


def _beside(path: Path) -> str:
    files = sorted(str(file) for file in path.parent.glob("*.yaml") if "." not in file.stem)  # no x.calibration.yaml
    return f"Robot files there: {', '.join(files)}." if files else f"Is '{path.parent}' the right folder?"
