"""A simulated input module with CiA 401 analogue inputs: load cells behind plain converters."""

import math
from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from simulators.nodes.canopen.node import CanopenNode
from simulators.nodes.canopen.pdo import Pdo
from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.node import Frame
from simulators.nodes.plant import Plant

CHANNELS = 4
RANGE = 10.0
"""The inputs read this at full scale [V], in the floating point object 6403h."""
_OVERRANGE = 0x0004
_BROKEN = 0x0020
"""These are bits of the maker's status object 2120h."""


@dataclass(frozen=True, slots=True)
class AnalogConstants:
    """Bridge amplifiers on the inputs of one converter.

    Attributes:
        full_scale: Force [N] at full scale of the converter.
        bits: Bits of the converter; its value lies in the highest bits of 6401h and 6402h.
        unbalance: Reading of an unloaded cell [N].
        more: `signal.element` of the forces on channels 2 and up, empty for a missing cell; the first is the
            node's own.
    """

    kind: ClassVar[str] = "analog_input"

    full_scale: float = 1000.0
    bits: int = 16
    unbalance: float = 0.0
    more: tuple[str, ...] = ()


class AnalogInput(CanopenNode):
    """Inputs that are read in three types at once: 16 bit, 32 bit, and volt as a floating point number.

    A broken converter reads its lower end.
    """

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        assert isinstance(spec.constants, AnalogConstants)
        self._constants = spec.constants
        elements = enumerate((spec.element, *spec.constants.more), 1)
        self._cells = [(channel, element) for channel, element in elements if element]
        super().__init__(spec, plant, outbox)

    def sample(self) -> None:
        """Measure every channel that has a cell; the others read zero."""
        values = self.objects.values
        status = _BROKEN if self.is_broken else 0
        half = 1 << self._constants.bits - 1
        for channel, element in self._cells:
            share = (self.plant.read(element) + self._constants.unbalance) / self._constants.full_scale
            if self.is_broken or math.isnan(share):
                share = -math.inf
            counts = round(max(-1.0, min(share, 1.0)) * half)
            if not -half < counts < half - 1:
                status |= _OVERRANGE
                counts = max(-half, min(counts, half - 1))
            values[0x6401, channel] = counts << 16 >> self._constants.bits
            values[0x6402, channel] = counts << 32 >> self._constants.bits
            values[0x6403, channel] = counts / half * RANGE
        values[0x2120, 0] = status

    @override
    def may_send(self, pdo: Pdo) -> bool:
        """Whether a PDO may be sent; one with analogue inputs only after 6423h allows it (CiA 401)."""
        return bool(self.objects.values[0x6423, 0]) or all(index >> 8 != 0x64 for index, _ in pdo.keys)
