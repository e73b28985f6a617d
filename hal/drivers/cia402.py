"""A servo drive that winds a wire [m] or turns a joint [rad], in cyclic synchronous position mode."""

from typing import Annotated, Literal

import can
import numpy as np
from pydantic import Field

from hal import calibration
from hal.config import Finite, Positive
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.canopen_node import HEARTBEAT, CanopenNode, NodeSettings, Taker
from hal.pdo_map import Pdo, PdoMap, lay_out
from hal.protocols import cia301, cia402
from hal.protocols.cia301 import Mapped
from hal.protocols.cia402 import State

RESET_CYCLES = 200
"""For so many cycles a fault reset is tried,"""
RESET_PERIOD = 4
"""as a rising edge in every fourth."""
LARGEST_COUNT = 2**31 - 1


class DriveSettings(NodeSettings):
    """Settings of a drive."""

    counts_per_turn: Positive
    """Encoder counts per motor turn."""
    gear: Positive = 1.0
    """Motor turns per turn of the output."""
    spool_radius: Positive | None = None
    """Radius of the spool [m]; without one the drive turns a joint."""
    direction: Literal[1, -1] = 1
    """1 if counts grow with the value, else -1."""
    zero: Finite = 0.0
    """Value at zero counts [m or rad]."""
    rated_torque: Positive | None = None
    """Motor rated torque [N m], for `torque`."""
    max_torque: Annotated[int, Field(ge=0, le=10_000)] | None = None
    """Written to object 6072h [thousandths of the rated torque]; absent: left as it is."""
    watch_time: Annotated[float, Field(ge=0.1, le=5.0)] = 0.15
    """How long [s] the drive waits for the HAL's heartbeat before it stops by itself (object 1016h)."""


class Cia402Drive(CanopenNode):
    """One drive. It is enabled only by `enable`, and stays disabled once it dropped out by itself."""

    Settings = DriveSettings

    @classmethod
    def quantities(cls, settings: DriveSettings) -> tuple[str, ...]:
        """See `CanDevice.quantities`."""
        return ("position",)

    @classmethod
    def commanded(cls, settings: DriveSettings) -> str:
        """See `CanDevice.commanded`."""
        return "position"

    @classmethod
    def traffic(cls, settings: DriveSettings, rate: float) -> tuple[tuple[int, float], ...]:
        """See `CanDevice.traffic`."""
        return ((cia402.COMMAND_LAYOUT.size, rate), (cia402.STATUS_LAYOUT.size, rate), HEARTBEAT)

    def __init__(self, place: Place, settings: DriveSettings) -> None:
        super().__init__(place, settings, cia402.PROFILE, PdoMap(lay_out(cia402.COMMAND), lay_out(cia402.STATUS)))
        shape = (settings.counts_per_turn, settings.gear, settings.direction, settings.zero)
        radius = settings.spool_radius
        self._line = calibration.spool(*shape, radius) if radius else calibration.rotary(*shape)
        self._scale, self._zero = self._line.scale, self._line.zero
        self._rated_torque = settings.rated_torque
        self._max_torque = settings.max_torque
        self._settings = settings
        self._state = State.NOT_READY
        self._counts = 0
        self._torque = 0
        self._is_wanted = False
        self._was_reached = False
        self._dropped = ""
        self._resetting = 0
        size = cia402.COMMAND_LAYOUT.size
        self._frame = can.Message(arbitration_id=cia301.RPDO1 + place.node, is_extended_id=False, data=bytearray(size))

    @property
    def torque(self) -> float:
        """Motor torque [N m] that the drive last reported; NaN without the setting `rated_torque`."""
        return self._torque / 1000 * (self._rated_torque or np.nan)

    def _watch_time(self) -> float:
        return self._settings.watch_time

    def _writes(self) -> tuple[tuple[Mapped, int], ...]:
        writes = [(cia402.MODE_OF_OPERATION, cia402.CYCLIC_SYNCHRONOUS_POSITION)]
        if self._max_torque is not None:
            writes.append((cia402.MAX_TORQUE, self._max_torque))
        if self._sdo.has(cia402.ABORT_CONNECTION.index):
            writes.append((cia402.ABORT_CONNECTION, cia402.ABORT_QUICK_STOP))
        return tuple(writes)

    def _before_commissioning(self) -> None:
        self._state = State.NOT_READY
        self._is_wanted = False
        self._sdo.write(cia402.CONTROLWORD.index, 0, cia402.DISABLE_VOLTAGE, 2)

    def _taker(self, pdo: Pdo) -> Taker:
        return self._take

    def _take(self, values: tuple[int, int, int], received: float) -> None:
        statusword, counts, self._torque = values
        self._counts = counts
        self._state = cia402.STATE_OF[statusword & 0x6F]
        self._keep(0, self._zero + self._scale * counts, received)

    def _lose(self, text: str) -> None:
        super()._lose(text)
        self._is_wanted = False
        self._state = State.NOT_READY

    def _running(self) -> tuple[DeviceState, str]:
        state = self._state
        if state is State.OPERATION_ENABLED:
            return DeviceState.ENABLED, ""
        if state is State.FAULT or state is State.FAULT_REACTION:
            return DeviceState.FAULT, f"{self._place} is in its state '{state}'. Look at its display, then reset."
        return DeviceState.READY, self._dropped

    def enable(self) -> None:
        """See `Device.enable`."""
        self._is_wanted, self._was_reached, self._dropped = True, False, ""

    def disable(self) -> None:
        """See `Device.disable`."""
        self._is_wanted = False

    def reset(self) -> None:
        """See `Device.reset`."""
        super().reset()
        self._resetting = RESET_CYCLES

    def apply(self, values: np.ndarray) -> None:
        """See `Device.apply`; until the drive is enabled its target is where it is."""
        state = self._state
        if self._is_wanted and self._was_reached and state is not State.OPERATION_ENABLED:
            self._is_wanted = False
            self._dropped = f"{self._place} left 'operation enabled' by itself and is '{state}'."
        if not self._is_wanted:
            self.idle()
            return
        target = self._counts
        if state is State.OPERATION_ENABLED:
            self._was_reached = True
            target = max(-LARGEST_COUNT, min(self._line.to_counts(float(values[0])), LARGEST_COUNT))
        self._command(cia402.towards_enabled(state), target)

    def idle(self) -> None:
        """See `Device.idle`; the drive is led to a state without power, and out of a fault if that was asked."""
        word = cia402.towards_disabled(self._state)
        if self._resetting:
            if self._state is State.FAULT and self._resetting % RESET_PERIOD == 0:
                word = cia402.FAULT_RESET
            self._resetting = self._resetting - 1 if self._state in (State.FAULT, State.FAULT_REACTION) else 0
        self._command(word, self._counts)

    def _command(self, word: int, target: int) -> None:
        if self.is_commissioned and self._received[0] > -np.inf:
            cia402.COMMAND_LAYOUT.pack_into(self._frame.data, 0, word, target)
            self._bus.send(self._frame)
