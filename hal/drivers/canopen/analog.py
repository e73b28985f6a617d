"""What load cells have in common: channels of a CANopen device, each an object that is a force, torque or pressure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from hal.commissioning.pdo_map import Pdo, PdoMap, lay_out
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.canopen.node import HEARTBEAT, CanopenNode, NodeSettings, Taker, data_sheet
from hal.errors import ConfigError
from hal.protocols import cia301
from hal.protocols.cia301 import Mapped
from hal.section import Finite, Positive


def _differ(values: tuple[int, ...]) -> tuple[int, ...]:
    if len(set(values)) < len(values):
        raise ValueError(f"{', '.join(map(str, values))} names a channel twice")
    return values


ChannelNumber = Annotated[int, Field(ge=1, le=254)]


class AnalogSettings(NodeSettings):
    """Settings of a device with measuring channels: value = zero + gain * what the device says."""

    measures: Literal["force", "torque", "pressure"] = "force"
    """What the channels measure [N, N m or Pa]; also the name of the quantity."""
    channels: Annotated[tuple[ChannelNumber, ...], Field(min_length=1), AfterValidator(_differ)] = (1,)
    """Sub-indices that are used. The quantity of one is called `force`, those of several `force_1`, `force_2`..."""
    value: str | None = None
    """Object and type in place of the preset's, as `7130h int16`; the sub-index is the channel unless it is given."""
    status: str | None = None
    """Object and type that tells whether the value is good, in place of the preset's, as `2120h:0 uint16`; the
    sub-index is the channel unless it is given."""
    bad_status: Annotated[int, Field(ge=1)] = 0xFFFF_FFFF
    """Bits of the status that make a value bad."""
    gain: Finite | tuple[Finite, ...] | None = None
    """SI units per unit of the device, one number or one per channel; negative if pulling reads negative. It must be
    given where the device tells raw counts; else 1."""
    zero: Finite | tuple[Finite, ...] = 0.0
    """Added [SI unit], one number or one per channel."""
    frozen_after: Positive | None = None
    """A value that stays the same to the last bit for so long [s] is not believed; only for a cell whose last bit is
    noise."""


@dataclass(slots=True)
class Channel:
    """One measuring channel.

    Attributes:
        number: Its sub-index.
        quantity: As the robot file names it.
        value: What is mapped.
        status: What tells whether the value is good; None if nothing does.
        slot: Where in `read` its value goes.
        zero: Added [SI unit].
        gain: As set.
        scale: SI units per number of the device; not known before it was read from there.
        bounds: Numbers at or beyond which the value is an overload.
        bad: Status bits now that make the value bad.
        number_now: What the device said last.
        changed: When that was another number [monotonic s].
        trouble: Why the value now is not to be used; empty if it is.
    """

    number: int
    quantity: str
    value: Mapped
    status: Mapped | None
    slot: int
    zero: float
    gain: float
    bounds: tuple[float, float]
    scale: float = math.nan
    bad: int = 0
    number_now: float = math.nan
    changed: float = -math.inf
    trouble: str = ""


class AnalogNode(CanopenNode):
    """Channels whose values answer every SYNC. A value that the device does not vouch for is NaN."""

    Settings = AnalogSettings

    @classmethod
    def quantities(cls, settings: Any) -> tuple[str, ...]:
        """See `CanDevice.quantities`."""
        if len(settings.channels) == 1:
            return (settings.measures,)
        return tuple(f"{settings.measures}_{number}" for number in settings.channels)

    @classmethod
    def traffic(cls, settings: Any, rate: float) -> tuple[tuple[int, float], ...]:
        """See `CanDevice.traffic`."""
        return cls.traffic_of(settings, rate, cls.quantities(settings))

    @classmethod
    def traffic_of(cls, settings: Any, rate: float, quantities: tuple[str, ...]) -> tuple[tuple[int, float], ...]:
        """See `CanDevice.traffic_of`."""
        channels = zip(settings.channels, cls.quantities(settings), strict=True)
        objects = [cls._objects(settings, number) for number, quantity in channels if quantity in quantities]
        return (*_map(objects).frames(rate), HEARTBEAT)

    @classmethod
    def _objects(cls, settings: Any, channel: int) -> tuple[Mapped, Mapped | None]:
        """Value and status of a channel."""
        raise NotImplementedError

    def __init__(self, place: Place, settings: AnalogSettings, profile: int) -> None:
        """Prepare; what is not read by the robot file is not mapped.

        Raises:
            ConfigError: An object, a gain or a zero that makes no sense.
        """
        used = [
            (slot, position, number)
            for position, (number, quantity) in enumerate(
                zip(settings.channels, self.quantities(settings), strict=True)
            )
            for slot, name in enumerate(place.elements)
            if name == quantity
        ]
        self._channels = [self._channel(place, settings, *entry) for entry in used]
        self._settings = settings
        super().__init__(place, settings, profile, _map([(c.value, c.status) for c in self._channels]))

    def _channel(self, place: Place, settings: AnalogSettings, slot: int, position: int, number: int) -> Channel:
        value, status = self._objects(settings, number)
        if status is not None and settings.status is None:  # a device may do without one
            entry = data_sheet(place.folder / settings.eds).get_variable(status.index, status.subindex)
            status = status if entry is not None and entry.pdo_mappable else None
        gain = _of(settings.gain, settings, position, f"{place}: gain")
        zero = _of(settings.zero, settings, position, f"{place}: zero")
        if gain == 0.0:
            raise ConfigError(f"{place}: a gain of zero would make every value the same.")
        quantity = self.quantities(settings)[position]
        bounds = self._bounds(settings, value)
        return Channel(number, quantity, value, status, slot, zero or 0.0, gain or 1.0, bounds)

    def _bounds(self, settings: Any, value: Mapped) -> tuple[float, float]:
        """Numbers at or beyond which a value is an overload: the ends of its type."""
        if value.kind == "float":
            return -math.inf, math.inf
        if value.kind == "unsigned":
            return -1, (1 << value.bits) - 1
        half = 1 << value.bits - 1
        return -half, half - 1

    def _taker(self, pdo: Pdo) -> Taker:
        places = {item: place for place, item in enumerate(pdo.objects)}
        statuses = [(places[c.status], c) for c in self._channels if c.status in places]
        values = [(places[c.value], c) for c in self._channels if c.value in places]
        bad = self._settings.bad_status

        def take(objects: tuple[Any, ...], received: float) -> None:
            for place, channel in statuses:
                channel.bad = objects[place] & bad
            for place, channel in values:
                self._measure(channel, objects[place], received)

        return take

    def _measure(self, channel: Channel, number: float, received: float) -> None:
        """Keep a value, or NaN if the device, an emergency, its range or its stillness says that it is none."""
        low, high = channel.bounds
        if number != channel.number_now:
            channel.number_now, channel.changed = number, received
        limit = self._settings.frozen_after
        if channel.bad:
            channel.trouble = self._describe(channel.bad)
        elif not low < number < high:
            channel.trouble = "overload: it reads an end of its range"
        elif limit is not None and received - channel.changed > limit:
            channel.trouble = f"frozen: its value has not changed by a bit for more than {limit:g} s"
        elif self._emergency or self._twin:
            channel.trouble = "the device reports a fault"
        else:
            channel.trouble = ""
            self._keep(channel.slot, channel.zero + channel.gain * channel.scale * number, received)
            return
        self._keep(channel.slot, math.nan, received)

    def _describe(self, bad: int) -> str:
        """Bad status bits in words."""
        return f"status {bad:X}h"

    def _troubles(self) -> list[str]:
        """What is wrong though the device answers and reports no fault."""
        return [f"{channel.quantity}: {channel.trouble}" for channel in self._channels if channel.trouble]

    def _running(self) -> tuple[DeviceState, str]:
        troubles = self._troubles()
        return DeviceState.READY, f"{self._place}: {'; '.join(troubles)}." if troubles else ""


def parse(text: str, channel: int, what: str) -> Mapped:
    """The object of a channel that a person writes as `7130h int16` or, with its sub-index, `2120h:0 uint16`.

    Raises:
        ConfigError: It is none.
    """
    place, _, kind = text.strip().partition(" ")
    try:
        found = cia301.mapped(place, kind.strip())
    except ValueError as error:
        raise ConfigError(f"{what} '{text}': {error} Write an object and its type: 7130h int16.") from None
    return found if ":" in place else Mapped(found.index, channel, found.bits, found.kind)


def _of(given: float | tuple[float, ...] | None, settings: AnalogSettings, position: int, what: str) -> float | None:
    """The number of one channel, where one was given for all or one for each."""
    if not isinstance(given, tuple):
        return given
    if len(given) != len(settings.channels):
        raise ConfigError(f"{what} has {len(given)} numbers for {len(settings.channels)} channels.")
    return given[position]


def _map(channels: Sequence[tuple[Mapped, Mapped | None]]) -> PdoMap:
    """A channel's value and its own status in one PDO; a status that is all channels' in the first."""
    statuses = [status for _, status in channels]
    shared = statuses[0] if statuses and len(channels) > 1 and len(set(statuses)) == 1 else None
    groups = [(value,) if status in (None, shared) else (value, status) for value, status in channels]
    return PdoMap(sends=lay_out([(shared,), *groups] if shared else groups))
