"""Typed models of a robot file (robots/*.yaml). An unknown key is an error that lists the known keys."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator, model_validator

from hal.calibration.units import check_robot_unit, check_units, factor
from hal.errors import ConfigError


class Section(BaseModel):
    """A part of the robot file: frozen, unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Rate = Annotated[float, Field(gt=0, le=10_000, allow_inf_nan=False)]
"""A rate [Hz] is at most what a loop in Python can reach."""
Finite = Annotated[float, Field(allow_inf_nan=False)]


def per_element(value: float | tuple[float, ...] | None, size: int, where: str, default: float = np.nan) -> np.ndarray:
    """Return one value per element, shape (size,), from one value for all or one for each; `default` for None.

    Raises:
        ValueError: The number of values is not `size`.
    """
    array = np.asarray(default if value is None else value, float)
    if array.ndim and array.shape != (size,):
        raise ValueError(f"{where} has {array.size} values, the signal has {size}.")
    return np.broadcast_to(array, (size,)).copy()


class NumbersConfig(Section):
    """Numbers of one signal, in its unit unless the section declares another one."""

    written_in: str | None = None
    """Unit of the numbers of this section, if it differs from that of the signal; rates are in this unit per second."""

    def in_unit(self, unit: str, where: str) -> Self:
        """Return these numbers in `unit`, that of their signal; `where` is their place in the robot file.

        Raises:
            ValueError: `written_in` cannot be converted to it.
        """
        if self.written_in is None:
            return self
        try:
            check_units(unit, self.written_in)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        scale = factor(unit, self.written_in)
        numbers = ((name, value) for name, value in self if isinstance(value, int | float | tuple))
        scaled = {
            n: tuple(scale * v for v in value) if isinstance(value, tuple) else scale * value for n, value in numbers
        }
        return self.model_copy(update={**scaled, "written_in": None})


class RangeConfig(NumbersConfig):
    """Range of one signal, per element or one for all."""

    low: Finite | tuple[Finite, ...] | None = None
    high: Finite | tuple[Finite, ...] | None = None

    def bounds(self, size: int, where: str) -> tuple[np.ndarray, np.ndarray]:
        """Return lowest and highest value, each of shape (size,); infinite where not stated.

        Args:
            size: Number of elements of the signal.
            where: Place in the robot file, for error messages.

        Raises:
            ValueError: The number of values is not `size`, or low is not below high.
        """
        low = per_element(self.low, size, f"{where}.low", -np.inf)
        high = per_element(self.high, size, f"{where}.high", np.inf)
        if np.any(low >= high):
            raise ValueError(f"{where}: low must be below high in every element.")
        return low, high


class LimitConfig(RangeConfig):
    """Limits of a measured or commanded signal, per element or one for all."""

    rate: Positive | tuple[Positive, ...] | None = None
    """Largest change of a command [unit/s]: velocity if positions are commanded, acceleration if velocities are."""
    acceleration: Positive | tuple[Positive, ...] | None = None
    """Largest change of that rate [unit/s^2], for commanded positions."""
    soft_high: Positive | tuple[Positive, ...] | None = None
    """Measured load above which the command is relaxed: muscle tension, or effort of a drive in both directions."""
    trip_low: Finite | tuple[Finite, ...] | None = None
    """Measured value below which the robot stops and disables, such as the tension of a slack muscle."""
    trip_high: Finite | tuple[Finite, ...] | None = None
    """Measured value above which the robot stops and disables."""

    def check(self, size: int, where: str, is_commanded: bool) -> None:
        """Check that the limits of a signal of `size` elements are consistent.

        Raises:
            ValueError: They are not.
        """
        self.bounds(size, where)
        ladder = [
            (label, per_element(getattr(self, label), size, f"{where}.{label}"))
            for label in ("trip_low", "low", "high", "soft_high", "trip_high")
        ]
        for index, (lower, below) in enumerate(ladder):
            for upper, above in ladder[index + 1 :]:
                if (lower, upper) != ("high", "soft_high") and np.any(below >= above):
                    raise ValueError(f"{where}: {lower} must be below {upper}.")
        for label in ("rate", "acceleration"):
            per_element(getattr(self, label), size, f"{where}.{label}")
            if getattr(self, label) is not None and not is_commanded:
                raise ValueError(f"{where}.{label} is of a command, but this signal is not the commanded one.")

    @property
    def is_watched(self) -> bool:
        """Whether the HAL must measure the signal."""
        return any(value is not None for value in (self.soft_high, self.trip_low, self.trip_high))


class CommandConfig(Section):
    """Commanded signal, lifetime of a command, and behaviour without commands."""

    signal: str
    time_to_live: Annotated[float, Field(gt=0, le=10)] = 0.1
    """A command is followed up to this age [s]."""
    hold: Annotated[float, Field(ge=0)] = 1.0
    """The last applied command is held for this time [s] before the robot stops; a stop holds or damps as long."""


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
    source: Literal["hal", "vision"] = "hal"
    """Publisher of the signal: the HAL, or the process of a camera."""
    computed: ComputedConfig | None = None
    """Computation by the HAL; None for a signal that devices measure."""

    @field_validator("unit", mode="before")
    @classmethod
    def _is_unit(cls, unit: object) -> str:
        text = str(unit or "")  # `unit: 1` is a number in YAML
        check_robot_unit(text)
        return text

    @property
    def is_measured(self) -> bool:
        """Whether devices on the buses measure it."""
        return self.source == "hal" and self.computed is None

    @property
    def size(self) -> int:
        """Number of elements."""
        return len(self.elements)


class BusConfig(Section):
    """One CAN bus, in the terms of python-can."""

    interface: str = "socketcan"
    channel: str
    bitrate: int = 1_000_000
    max_load: Annotated[float, Field(gt=0, le=0.8)] = 0.6
    """Largest share of the bit rate for the cyclic frames; the HAL does not start with more."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Arguments for python-can."""


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
    urdf: Path | None = None
    """URDF file for the live page, relative to the robot file."""
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
        if not self.signals[self.command.signal].is_measured:
            raise ValueError(f"command.signal '{self.command.signal}' must be measured by devices, to start from it.")
        for name in self.signals:
            self._computed_fits(name)
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
        if self.devices:
            missing = [e for e in self.element_names(self.measured) if e not in elements]
            if missing:
                raise ValueError(
                    f"no device measures {', '.join(missing)}. Add one, remove the element, or set `source: vision`."
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
        if self.signals[name].source != "hal" and limit.is_watched:
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
        known = self.element_names(self.measured)
        for element in device.served:
            if element not in known:
                which = "a device cannot measure" if element in self.element_names() else "no signal has"
                raise ValueError(
                    f"device '{name}' serves '{element}', which {which}. Known elements: {', '.join(known)}."
                )

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the signals that devices measure."""
        return tuple(name for name, signal in self.signals.items() if signal.is_measured)

    @property
    def seen(self) -> tuple[str, ...]:
        """Names of the signals that the process of a camera publishes."""
        return tuple(name for name, signal in self.signals.items() if signal.source == "vision")

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
    try:
        raw = yaml.safe_load(path.read_text())
    except FileNotFoundError:
        raise ConfigError(f"There is no robot file '{path}'. {_beside(path)}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"Robot file '{path}' cannot be read: {error}.") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"Robot file '{path}' is not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(raw, dict):
        raise ConfigError(f"Robot file '{path}' is empty or not a mapping. Compare it with robots/*.yaml.")
    try:
        return RobotConfig.model_validate({**raw, "folder": path.resolve().parent})
    except ValidationError as error:
        raise ConfigError(f"Robot file '{path}': {explain(error, RobotConfig)}") from None


def _beside(path: Path) -> str:
    files = sorted(str(file) for file in path.parent.glob("*.yaml") if "." not in file.stem)  # no x.calibration.yaml
    return f"Robot files there: {', '.join(files)}." if files else f"Is '{path.parent}' the right folder?"


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """Return one problem as a sentence: an unknown key with the known keys there, otherwise the first problem."""
    problems = error.errors()
    first = next((problem for problem in problems if problem["type"] == "extra_forbidden"), problems[0])
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        fields = _model_at(model, first["loc"][:-1]).model_fields
        known = ", ".join(field.alias or name for name, field in fields.items())
        return f"unknown key '{where}'. Known keys there: {known}."
    message = first["msg"].removeprefix("Value error, ")
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    sentence = f"{message.removesuffix('.')}{more}"
    return f"{where + ': ' if where else ''}{sentence}{'' if sentence.endswith('?') else '.'}"


def _model_at(model: type[BaseModel], location: tuple[int | str, ...]) -> type[BaseModel]:
    for part in location:
        field = model.model_fields.get(str(part))
        if field is None:
            continue  # a key of a mapping, such as the name of a device
        inner = [field.annotation, *getattr(field.annotation, "__args__", ())]
        models = [kind for kind in inner if isinstance(kind, type) and issubclass(kind, BaseModel)]
        model = models[0] if models else model
    return model
