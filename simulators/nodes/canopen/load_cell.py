"""A simulated load cell with a CiA 404 measuring amplifier of several channels."""

import math

from typing_extensions import override

from simulators.nodes.canopen.node import CanopenNode
from simulators.nodes.canopen.objects import Abort, Refused, Value
from simulators.nodes.canopen.spec import CellConstants, NodeSpec
from simulators.nodes.node import Frame
from simulators.nodes.plant import Plant

CHANNELS = 4
ZERO = int.from_bytes(b"zero", "little")
"""This signature tares the input when written to 6125h."""

NOT_VALID, POSITIVE_OVERLOAD, NEGATIVE_OVERLOAD = 1, 2, 4
"""These are bits of the status 6150h."""

_LARGEST = 1e9
"""The scaling that a master has set makes no sense for a process value beyond this."""


class LoadCell(CanopenNode):
    """Per channel: field value (counts) times scaling factor plus offsets is the process value [the channel's unit]."""

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        assert isinstance(spec.constants, CellConstants)
        self._constants = spec.constants
        elements = enumerate((spec.element, *spec.constants.more), 1)
        self._cells = [(channel, element) for channel, element in elements if element]
        super().__init__(spec, plant, outbox)
        constants = self._constants
        for channel in range(1, CHANNELS + 1):
            self.objects.power_on |= {
                (0x6126, channel): 1.0 / (constants.counts_per_newton * constants.unit_size),
                (0x6131, channel): constants.unit,
                (0x6132, channel): constants.decimal_digits,
                (0x6150, channel): NOT_VALID,
            }
        self.objects.on_write[0x6125] = self._tare

    @override
    def sample(self) -> None:
        """Measure; a channel without a cell stays as at power-on."""
        for channel, element in self._cells:
            self.objects.values[0x6150, channel] = self._convert(channel, element)

    def _convert(self, channel: int, element: str) -> int:
        """Bring field value and process value of a channel up to date; its status."""
        values = self.objects.values
        force = self.plant.read(element) + self._constants.unbalance
        if math.isnan(force) or self.is_broken or not values[0x6112, channel]:
            return NOT_VALID
        capacity = self._constants.capacity
        field_value = round(min(max(force, -capacity), capacity) * self._constants.counts_per_newton)
        offset = float(values[0x6127, channel]) + float(values[0x6124, channel])
        process_value = field_value * float(values[0x6126, channel]) + offset
        if not abs(process_value) < _LARGEST:
            return NOT_VALID
        whole = round(process_value * 10 ** int(values[0x6132, channel]))
        values[0x7100, channel] = _fitting(field_value, 16)
        values[0x9100, channel] = field_value
        values[0x6130, channel] = process_value
        values[0x7130, channel] = _fitting(whole, 16)
        values[0x9130, channel] = _fitting(whole, 32)
        return POSITIVE_OVERLOAD if force > capacity else NEGATIVE_OVERLOAD if force < -capacity else 0

    def _tare(self, channel: int, old: Value, new: Value) -> None:
        if not 1 <= channel <= CHANNELS:
            return
        if new != ZERO:
            raise Refused(Abort.VALUE)
        self.sample()
        values = self.objects.values
        if values[0x6150, channel] == NOT_VALID:
            raise Refused(Abort.DEVICE_STATE)
        values[0x6124, channel] = float(values[0x6124, channel]) - float(values[0x6130, channel])


def _fitting(value: int, bits: int) -> int:
    """Return the nearest number that a signed integer of `bits` bits can hold."""
    half = 1 << bits - 1
    return min(max(value, -half), half - 1)
