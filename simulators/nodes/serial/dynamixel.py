"""A simulated Dynamixel servo of the X series, protocol 2.0.

Source: emanual.robotis.com, "DYNAMIXEL Protocol 2.0" and the control table of the XL330 and XM430. It has the reported
oddities: the watchdog of the 330 models does not stop the motor (forum.robotis.com/t/4814), and a position outside of
one turn changes by a turn when the torque is switched on in position mode (forum.robotis.com/t/7814).
"""

import math

from typing_extensions import override

from simulators.nodes.serial.node import COUNTS, MIDDLE, PER_COUNT, SerialNode

PING, READ, WRITE, REG_WRITE, ACTION, REBOOT, STATUS, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 8, 0x55, 0x82, 0x83
HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
RESULT_FAIL, INSTRUCTION_ERROR, CRC_ERROR, RANGE, LENGTH, LIMIT, ACCESS = 1, 2, 3, 4, 5, 6, 7
ALERT = 0x80
LASTING = 64
BOOT = 0.3
"""A reboot takes this time [s]."""
_DRIVE_MODE, _MODE, _VELOCITY_LIMIT, _HIGHEST, _LOWEST = 10, 11, 44, 48, 52
_TORQUE, _LEVEL, _HARDWARE_ERROR, _WATCHDOG, _GOAL_CURRENT, _GOAL_VELOCITY, _GOAL = 64, 68, 70, 98, 102, 104, 116
_TICK, _MOVING, _CURRENT, _VELOCITY, _POSITION, _VOLTAGE, _TEMPERATURE = 120, 122, 126, 128, 132, 144, 146
_GOALS = range(100, 120)
_READ_ONLY = (*range(7), *range(120, 148), _HARDWARE_ERROR)
_RPM = 0.229 * 2.0 * math.pi / 60.0
_OVERHEATED = 0x04
_WITHOUT_CURRENT = (1060, 1070, 1080, 1090, 1160)


def crc16(data: bytes) -> int:
    """Return the checksum of a packet, bit by bit as the document defines it: polynomial 8005h, start 0."""
    value = 0
    for byte in data:
        for bit in range(7, -1, -1):
            top = value >> 15 & 1
            value = value << 1 & 0xFFFF
            if top ^ byte >> bit & 1:
                value ^= 0x8005
    return value


def packets(received: bytearray) -> list[tuple[int, int, bytes]]:
    """Return (id, instruction, parameters) of the packets in `received`, and remove them; broken ones are skipped."""
    complete: list[tuple[int, int, bytes]] = []
    while len(received) >= 10:
        if received[:4] != HEADER:
            del received[0]
            continue
        end = 7 + received[5] + 256 * received[6]
        if end > 2000:
            del received[0]
            continue
        if len(received) < end:
            break
        packet = bytes(received[:end])
        del received[:end]
        if end >= 10 and crc16(packet[:-2]) == packet[-2] + 256 * packet[-1] and packet[7] != STATUS:
            complete.append((packet[4], packet[7], _unstuffed(packet[8:-2])))
    return complete


def _unstuffed(data: bytes) -> bytes:
    """Return data without the one FDh that the sender put after each FFh FFh FDh; a further FDh is data."""
    plain, is_stuffed = bytearray(), False
    for byte in data:
        if is_stuffed and byte == 0xFD:
            is_stuffed = False
            continue
        plain.append(byte)
        is_stuffed = plain[-3:] == b"\xff\xff\xfd"
    return bytes(plain)


class DynamixelNode(SerialNode):
    """One servo of the X series."""

    SIZE = 660

    def __init__(self, spec, plant) -> None:  # type: ignore[no-untyped-def]
        super().__init__(spec, plant)
        self._pending: tuple[int, bytes] | None = None
        self._heard = 0.0
        self._turns = 0
        constants = self.constants
        self.put(0, 2, constants.model)
        self.put(6, 1, constants.firmware)
        self.put(7, 1, spec.node)
        self.put(8, 1, 3)
        self.put(9, 1, 250)
        self.put(_MODE, 1, 3)
        self.put(13, 1, 2)
        self.put(38, 2, 1193)
        self.put(_VELOCITY_LIMIT, 4, round(constants.fastest / _RPM))
        self.put(_HIGHEST, 4, constants.highest)
        self.put(_LOWEST, 4, constants.lowest)

    @override
    def reset_memory(self) -> None:
        self.table[64:168] = bytes(104)
        self.put(_LEVEL, 1, 2)
        self._pending = None
        self._turns = 0
        self.put(_GOAL, 4, self._counts(), True)

    @property
    @override
    def is_on(self) -> bool:
        return bool(self.table[_TORQUE])

    @property
    @override
    def error(self) -> int:
        return self.table[_HARDWARE_ERROR]

    @property
    def _is_expired(self) -> bool:
        return self.table[_WATCHDOG] == 0xFF

    @property
    @override
    def goal(self) -> float:
        if self.table[_MODE] in (0, 1, 16):
            return math.nan
        if self._is_expired and not self.constants.has_dead_watchdog:
            return self._target
        return (self.number(_GOAL, 4, True) - MIDDLE - self._turns * COUNTS) * PER_COUNT

    @property
    @override
    def goal_speed(self) -> float:
        if self._is_expired and not self.constants.has_dead_watchdog:
            return 0.0
        if self.table[_MODE] == 1:
            return self.number(_GOAL_VELOCITY, 4, True) * _RPM
        if self.table[_MODE] == 0:  # a friction that grows with speed balances the current
            return self.number(_GOAL_CURRENT, 2, True) * 2e-3 * self.constants.fastest
        return self.constants.fastest

    @override
    def break_down(self) -> None:
        """Report that it is too hot, without torque; only a reboot ends this."""
        self.table[_HARDWARE_ERROR] |= _OVERHEATED
        self.put(_TORQUE, 1, 0)

    @override
    def tick(self, now: float) -> None:
        watch = self.table[_WATCHDOG]
        if self.is_powered and self.is_on and 1 <= watch <= 127 and now - self._heard > 0.02 * watch:
            self.table[_WATCHDOG] = 0xFF
            if not self.constants.has_dead_watchdog:
                self.halt()
        super().tick(now)

    @override
    def answer(self, instruction: int, parameters: bytes, is_broadcast: bool, now: float) -> bytes | None:
        level = self.table[_LEVEL]
        if instruction == PING:
            return self._status(0, bytes(self.table[0:2]) + bytes((self.table[6],)))
        if instruction in (READ, SYNC_READ):
            if len(parameters) < 4:
                return self._status(LENGTH, b"") if not is_broadcast else None
            address, size = int.from_bytes(parameters[:2], "little"), int.from_bytes(parameters[2:4], "little")
            if not level:
                return None
            if address + size > self.SIZE:
                return self._status(RANGE, b"")
            self._measure(now)
            return self._status(0, bytes(self.table[address : address + size]))
        error = INSTRUCTION_ERROR
        if instruction in (WRITE, SYNC_WRITE) and len(parameters) > 2:
            error = self._write(int.from_bytes(parameters[:2], "little"), parameters[2:])
        elif instruction == REG_WRITE and len(parameters) > 2:
            self._pending, error = (int.from_bytes(parameters[:2], "little"), parameters[2:]), 0
        elif instruction == ACTION:
            error = self._write(*self._pending) if self._pending else RESULT_FAIL
            self._pending = None
        elif instruction == REBOOT:
            packet = self._status(0, b"")
            self.power_up(now)
            self.be_deaf(BOOT, now)
            return packet if level == 2 and not is_broadcast else None
        return self._status(error, b"") if level == 2 and not is_broadcast else None

    def heard(self, now: float) -> None:
        """Note an instruction packet on the line, for any servo."""
        self._heard = now

    def _write(self, address: int, data: bytes) -> int:
        """Write registers and return the error number; 0 without an error."""
        places = range(address, address + len(data))
        if places.stop > self.SIZE:
            return RANGE
        if any(place in _READ_ONLY for place in places) or (address < LASTING and self.is_on):
            return ACCESS
        if self._is_expired and any(place in _GOALS for place in places):
            return RANGE
        value = int.from_bytes(data, "little", signed=True)
        in_range = self.number(_LOWEST, 4) <= value <= self.number(_HIGHEST, 4)
        if address == _GOAL and len(data) == 4 and self.table[_MODE] == 3 and not in_range:
            return LIMIT
        if address == _GOAL_VELOCITY and abs(value) > self.number(_VELOCITY_LIMIT, 4):
            return LIMIT
        if address == _TORQUE and len(data) == 1:
            if data[0] > 1:
                return RANGE
            if data[0] and self.error:
                return 0  # it does not take it, and does not say so
            if data[0] and not self.is_on:
                if self.table[_MODE] == 3:
                    self._turns -= self._counts() // COUNTS
                self.put(_GOAL, 4, self._counts(), True)
        self.table[address : places.stop] = data
        return 0

    def _counts(self) -> int:
        return self.counts + self._turns * COUNTS

    def _measure(self, now: float) -> None:
        force = self.drive
        scale = 1000.0 if self.constants.model in _WITHOUT_CURRENT else self.constants.stall_current / self._current
        self.put(_TICK, 2, int(now * 1000) % 32768)
        self.put(_MOVING, 1, int(abs(self.speed) > 0.01))
        self.put(_CURRENT, 2, round(force * scale), True)
        self.put(_VELOCITY, 4, round(self.speed / _RPM), True)
        self.put(_POSITION, 4, self._counts(), True)
        self.put(_VOLTAGE, 2, 119)
        self.put(_TEMPERATURE, 1, 82 if self.error & _OVERHEATED else 34)

    @property
    def _current(self) -> float:
        return 1e-3 if 1190 <= self.constants.model <= 1240 else 2.69e-3

    def _status(self, error: int, data: bytes) -> bytes:
        body = bytes((STATUS, error | (ALERT if self.error else 0))) + data
        stuffed = bytearray()
        for byte in body:
            stuffed.append(byte)
            if stuffed[-3:] == b"\xff\xff\xfd":
                stuffed.append(0xFD)
        packet = HEADER + bytes((self.spec.node,)) + (len(stuffed) + 2).to_bytes(2, "little") + bytes(stuffed)
        return packet + crc16(packet).to_bytes(2, "little")
