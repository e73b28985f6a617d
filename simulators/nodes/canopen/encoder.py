"""A simulated CiA 406 absolute encoder."""

import math

from typing_extensions import override

from simulators.nodes.canopen.node import CanopenNode
from simulators.nodes.canopen.objects import Value
from simulators.nodes.canopen.spec import EncoderConstants, NodeSpec
from simulators.nodes.node import Frame
from simulators.nodes.plant import Plant

REVERSED, SCALED = 1, 4
"""These are bits of the operating parameters 6000h."""
POSITION_ERROR = 1
"""This is a bit of the alarms 6503h."""


class JointEncoder(CanopenNode):
    """Position value = physical position, reversed, scaled and offset as 6000h to 6003h ask, within the range."""

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        assert isinstance(spec.constants, EncoderConstants)
        self._constants = spec.constants
        self._before: tuple[float, int] | None = None
        super().__init__(spec, plant, outbox)
        constants = self._constants
        self.objects.power_on |= {
            (0x6000, 0): SCALED if constants.scaled_to else 0,
            (0x6001, 0): constants.scaled_to or constants.counts_per_turn,
            (0x6002, 0): (constants.scaled_to or constants.counts_per_turn) * constants.turns,
            (0x6031, 3): constants.speed_unit[0],
            (0x6031, 4): constants.speed_unit[1],
            (0x6501, 0): constants.counts_per_turn,
            (0x6502, 0): constants.turns,
            (0x650B, 0): spec.serial,
        }
        self.objects.on_write[0x6003] = self._preset

    @override
    def restart(self) -> None:
        self._before = None

    @override
    def break_down(self) -> None:
        super().break_down()
        self.objects.values[0x6503, 0] = POSITION_ERROR

    def sample(self) -> None:
        """Measure position and speed; the position keeps its value while the alarm stands."""
        values = self.objects.values
        values[0x6500, 0] = values[0x6000, 0]
        if values[0x6503, 0] == POSITION_ERROR:
            return
        measured = self._measured()
        if measured is None:
            values[0x6503, 0] = POSITION_ERROR
            return
        position = (measured + int(values[0x6509, 0])) % self._range()
        self._differentiate(position)
        values[0x6004, 0] = position

    def _measured(self) -> int | None:
        """Return the position before the preset's offset [units]; None if the world has none."""
        values, constants = self.objects.values, self._constants
        angle = self.plant.read(self.spec.element)
        if not math.isfinite(angle):
            return None
        total = constants.counts_per_turn * constants.turns
        turns = constants.direction * (angle - constants.zero) / (2.0 * math.pi)
        counts = math.floor(turns * constants.counts_per_turn) % total
        if int(values[0x6000, 0]) & REVERSED:
            counts = -counts % total
        if int(values[0x6000, 0]) & SCALED:
            counts = counts * int(values[0x6001, 0]) // constants.counts_per_turn
        return counts % self._range()

    def _range(self) -> int:
        """Return the number of units after which the position begins again."""
        if int(self.objects.values[0x6000, 0]) & SCALED:
            return int(self.objects.values[0x6002, 0])
        return self._constants.counts_per_turn * self._constants.turns

    def _preset(self, sub: int, old: Value, new: Value) -> None:
        """Make the position now read as the preset value (6003h)."""
        measured = self._measured()
        if measured is not None:
            half = (self._range() + 1) // 2
            self.objects.values[0x6509, 0] = (int(new) - measured + half) % self._range() - half

    def _differentiate(self, position: int) -> None:
        time = self.plant.time
        if self._before is not None and time > self._before[0]:
            half = self._range() // 2
            moved = (position - self._before[1] + half) % self._range() - half
            values = self.objects.values
            scale = int(values[0x6031, 3]) / int(values[0x6031, 4])
            speed = round(moved / (time - self._before[0]) * scale)
            values[0x6030, 1] = min(max(speed, -(2**15)), 2**15 - 1)
        self._before = (time, position)
