"""A simulated load cell with a CiA 404 measuring amplifier."""

import math

from simulators.nodes.canopen_node import CanopenNode
from simulators.nodes.node import Frame
from simulators.nodes.objects import Abort, Refused, Value
from simulators.nodes.plant import Plant
from simulators.nodes.spec import CellConstants, NodeSpec

ZERO = int.from_bytes(b"zero", "little")
"""Signature that tares the input when written to 6125h."""

NOT_VALID, POSITIVE_OVERLOAD, NEGATIVE_OVERLOAD = 1, 2, 4
"""Bits of the status 6150h."""

_LARGEST = 1e9
"""Process value [N] beyond which the scaling that a master has set makes no sense."""


class LoadCell(CanopenNode):
    """One channel: field value (counts) times scaling factor plus offsets is the process value [N]."""

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        assert isinstance(spec.constants, CellConstants)
        self._constants = spec.constants
        self._is_broken = False
        super().__init__(spec, plant, outbox)
        self.objects.power_on |= {
            (0x6126, 1): 1.0 / self._constants.counts_per_newton,
            (0x6132, 1): self._constants.decimal_digits,
        }
        self.objects.on_write[0x6125] = self._tare

    def restart(self) -> None:
        """See `CanopenNode.restart`."""
        self._is_broken = False

    def break_down(self) -> None:
        """See `CanopenNode.break_down`."""
        super().break_down()
        self._is_broken = True

    def sample(self) -> None:
        """Field value, process value in its three forms, and status."""
        values = self.objects.values
        force = self.plant.read(self.spec.element) + self._constants.unbalance
        if math.isnan(force) or self._is_broken or not values[0x6112, 1]:
            values[0x6150, 1] = NOT_VALID
            return
        capacity = self._constants.capacity
        status = POSITIVE_OVERLOAD if force > capacity else NEGATIVE_OVERLOAD if force < -capacity else 0
        field_value = round(min(max(force, -capacity), capacity) * self._constants.counts_per_newton)
        process_value = field_value * float(values[0x6126, 1]) + float(values[0x6127, 1]) + float(values[0x6124, 1])
        if not abs(process_value) < _LARGEST:
            values[0x6150, 1] = NOT_VALID
            return
        whole = round(process_value * 10 ** int(values[0x6132, 1]))
        values[0x9100, 1] = field_value
        values[0x6130, 1] = process_value
        values[0x7130, 1] = min(max(whole, -(2**15)), 2**15 - 1)
        values[0x9130, 1] = min(max(whole, -(2**31)), 2**31 - 1)
        values[0x6150, 1] = status

    def _tare(self, sub: int, old: Value, new: Value) -> None:
        if sub == 1:
            if new != ZERO:
                raise Refused(Abort.VALUE)
            self.sample()
            values = self.objects.values
            if values[0x6150, 1] == NOT_VALID:
                raise Refused(Abort.DEVICE_STATE)
            values[0x6124, 1] = float(values[0x6124, 1]) - float(values[0x6130, 1])
