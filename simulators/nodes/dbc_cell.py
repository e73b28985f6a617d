"""A simulated load cell with the messages of robots/dbc/load_cell.dbc: 24 bits of force, a status, a counter."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from simulators.nodes.canopen.spec import NodeSpec
from simulators.nodes.node import Frame, Handler, SimulatedNode
from simulators.nodes.plant import Plant

GOOD, OVERLOAD, UNDERLOAD, SENSOR_BROKEN = 0, 1, 2, 4
TARE, FORGET_TARE = 1, 2

_FORCE, _REQUEST = 0x180, 0x200
_LARGEST = 0x7FFFFF


@dataclass(frozen=True, slots=True)
class DbcCellConstants:
    """Constants of the cell.

    Attributes:
        capacity: Force [N] beyond which it reports overload or underload.
        unbalance: Reading without load before a tare [N].
        period: Period of its messages [s].
    """

    kind: ClassVar[str] = "dbc_cell"

    capacity: float = 1000.0
    unbalance: float = 0.0
    period: float = 0.005


class DbcCell(SimulatedNode):
    """One load cell that sends with its own clock."""

    def __init__(self, spec: NodeSpec, plant: Plant, outbox: list[Frame]) -> None:
        assert isinstance(spec.constants, DbcCellConstants)
        self.spec = spec
        self.plant = plant
        self._constants = spec.constants
        self._outbox = outbox
        self.routes_changed: Callable[[], None] = lambda: None
        self.is_powered = False
        self.is_muted = False
        self._is_broken = False
        self._tare = 0.0
        self._counter = 0
        self._due = 0.0

    @property
    @override
    def condition(self) -> str:
        return "off" if not self.is_powered else "broken" if self._is_broken else "measuring"

    @override
    def routes(self) -> dict[int, Handler]:
        return {_REQUEST + self.spec.node: self._on_request}

    @override
    def sync(self, now: float) -> None:
        """Ignore SYNC, which this cell does not use."""

    @override
    def power_up(self, now: float) -> None:
        self.is_powered, self.is_muted, self._is_broken = True, False, False
        self._tare, self._counter, self._due = 0.0, 0, now

    @override
    def power_down(self) -> None:
        self.is_powered = False

    @override
    def break_down(self) -> None:
        """Break the strain gauge."""
        self._is_broken = True

    @override
    def tick(self, now: float) -> None:
        if not self.is_powered or now < self._due - 1e-9:
            return
        self._due = max(self._due + self._constants.period, now)
        force = self._force()
        capacity = self._constants.capacity
        status = OVERLOAD if force > capacity else UNDERLOAD if force < -capacity else GOOD
        if self._is_broken or math.isnan(force):
            force, status = 0.0, SENSOR_BROKEN
        thousandths = max(-_LARGEST - 1, min(round((force - self._tare) * 1000), _LARGEST)) % (1 << 24)
        data = bytes(
            (
                thousandths & 0xFF,
                thousandths >> 8 & 0xFF,
                thousandths >> 16,
                status | self._counter << 4,
                25 + 40,  # degrees Celsius from -40
            )
        )
        self._counter = (self._counter + 1) % 16
        if not self.is_muted:
            self._outbox.append((_FORCE + self.spec.node, data))

    def _force(self) -> float:
        return self.plant.read(self.spec.element) + self._constants.unbalance

    def _on_request(self, data: bytes, now: float) -> None:
        if self.is_powered and len(data) == 1:
            if data[0] == TARE:
                self._tare = self._force()
            elif data[0] == FORGET_TARE:
                self._tare = 0.0
