"""A simulated Feetech servo of the STS series.

Source: "Communication Protocol User Manual" and memory table of the STS series (doc.feetech.cn). Where users report
oddities, the node has them: a goal switches the torque on, torque that is switched on without a goal turns to the goal
of before, and after power-on the goal is 0.
"""

import math

from typing_extensions import override

from simulators.nodes.serial.node import MIDDLE, PER_COUNT, SerialNode

PING, READ, WRITE, REG_WRITE, ACTION, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 0x82, 0x83
HEADER = b"\xff\xff"
BROADCAST = 0xFE
LASTING = 40
"""Registers below this one keep their values without power; they are locked by register 55."""
_LEVEL, _LOW, _HIGH, _MODE, _TORQUE, _GOAL, _SPEED, _LIMIT, _LOCK = 8, 9, 11, 33, 40, 42, 46, 48, 55
_POSITION, _VELOCITY, _LOAD, _VOLTAGE, _TEMPERATURE, _STATUS, _MOVING, _CURRENT = 56, 58, 60, 62, 63, 65, 66, 69
_HOT = 0x04


def packets(received: bytearray) -> list[tuple[int, int, bytes]]:
    """Return (id, instruction, parameters) of the packets in `received`, and remove them; broken ones are skipped."""
    complete: list[tuple[int, int, bytes]] = []
    while len(received) >= 6:
        if received[:2] != HEADER:
            del received[0]
            continue
        if received[2] == 0xFF:
            del received[0]
            continue
        end = 4 + received[3]
        if len(received) < end:
            break
        packet = bytes(received[:end])
        del received[:end]
        if received_sum(packet[2:-1]) == packet[-1] and end >= 6:
            complete.append((packet[2], packet[4], packet[5:-1]))
    return complete


def received_sum(body: bytes) -> int:
    """Return the checksum of the bytes between header and checksum."""
    return 255 - sum(body) % 256


class FeetechNode(SerialNode):
    """One servo of the STS series."""

    SIZE = 90

    def __init__(self, spec, plant) -> None:  # type: ignore[no-untyped-def]
        super().__init__(spec, plant)
        self._pending: tuple[int, bytes] | None = None
        self._error = 0
        self.put(0, 1, 3)
        self.put(1, 1, 9)
        self.put(3, 2, self.constants.model)
        self.put(5, 1, spec.node)
        self.put(7, 1, 250)
        self.put(_LEVEL, 1, 1)
        self.put(_LOW, 2, self.constants.lowest)
        self.put(_HIGH, 2, self.constants.highest)
        self.put(13, 1, 70)
        self.put(16, 2, 1000)

    @override
    def reset_memory(self) -> None:
        self.table[40:] = bytes(self.SIZE - 40)
        self.put(_LIMIT, 2, 1000)
        self.put(_LOCK, 1, 1)
        self._error = 0
        self._pending = None

    @property
    @override
    def is_on(self) -> bool:
        return bool(self.table[_TORQUE])

    @property
    @override
    def error(self) -> int:
        return self._error

    @property
    @override
    def goal(self) -> float:
        if self.table[_MODE]:
            return math.nan
        counts = _sign(self.number(_GOAL, 2), 15)
        low, high = self.number(_LOW, 2), self.number(_HIGH, 2)
        if (low, high) != (0, 0):
            counts = max(low, min(high, counts))
        return (counts - MIDDLE) * PER_COUNT

    @property
    @override
    def goal_speed(self) -> float:
        counts = _sign(self.number(_SPEED, 2), 15)
        if not self.table[_MODE] and not counts:
            return self.constants.fastest
        return counts * PER_COUNT

    @override
    def break_down(self) -> None:
        """Report that it is too hot, without torque."""
        self._error |= _HOT
        self.put(_TORQUE, 1, 0)

    @override
    def answer(self, instruction: int, parameters: bytes, is_broadcast: bool, now: float) -> bytes | None:
        if instruction == PING:
            return self._status(b"")
        if instruction in (READ, SYNC_READ) and len(parameters) >= 2:
            address, size = parameters[0], parameters[1]
            self._measure()
            return self._status(bytes(self.table[address : address + size]).ljust(size, b"\0"))
        if instruction in (WRITE, SYNC_WRITE) and parameters:
            self._write(parameters[0], parameters[1:])
        elif instruction == REG_WRITE and parameters:
            self._pending = (parameters[0], parameters[1:])
        elif instruction == ACTION:
            if self._pending:
                self._write(*self._pending)
            self._pending = None
        else:
            return None
        return None if is_broadcast or not self.table[_LEVEL] else self._status(b"")

    def _write(self, address: int, data: bytes) -> None:
        for place, value in enumerate(data, address):
            if place >= _POSITION or place in (0, 1, 3, 4):
                continue  # read only
            if place < LASTING and self.table[_LOCK]:
                continue
            self.table[place] = value
        if address <= _TORQUE < address + len(data) and not self.table[_TORQUE]:
            self._error &= _HOT
        if address <= _GOAL < address + len(data):
            self.table[_TORQUE] = 1

    def _measure(self) -> None:
        drive = self.drive
        self.put(_POSITION, 2, _unsign(self.counts, 15))
        self.put(_VELOCITY, 2, _unsign(round(self.speed / PER_COUNT), 15))
        self.put(_LOAD, 2, _unsign(round(1000 * drive), 10))
        self.put(_VOLTAGE, 1, 74)
        self.put(_TEMPERATURE, 1, 75 if self._error & _HOT else 31)
        self.put(_STATUS, 1, self._error)
        self.put(_MOVING, 1, int(abs(self.speed) > 0.01))
        self.put(_CURRENT, 2, _unsign(round(drive * self.constants.stall_current / 6.5e-3), 15))

    def _status(self, data: bytes) -> bytes:
        body = bytes((self.spec.node, len(data) + 2, self._error)) + data
        return HEADER + body + bytes((received_sum(body),))


def _sign(raw: int, bit: int) -> int:
    size = raw % (1 << bit)
    return -size if raw >> bit & 1 else size


def _unsign(value: int, bit: int) -> int:
    size = min(abs(value), (1 << bit) - 1)
    return size + (1 << bit) if value < 0 else size
