"""Duration of frames on a real CAN bus, classic and of CAN FD, and their arbitration (ISO 11898-1:2015)."""

import heapq
from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass

from hal.protocols.can_frames import FD_SIZES, checksum_bits

EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
"""These flags are in the bits above the identifier, as in SocketCAN."""
FD = 1 << 32
"""This flag marks a frame of CAN FD that a node sends; on a socket the length has it."""

_TAIL_BITS = 13
"""CRC delimiter, acknowledge slot and delimiter, end of frame and the 3 bits between frames have this length [bits];
they are not stuffed.
"""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = (crc << 1) ^ (0x4599 if crc & 0x4000 else 0)
        table.append(crc & 0x7FFF)
    return tuple(table)


def _stuff(state: int, bits: int, count: int) -> tuple[int, int]:
    """Send `count` bits from a state (last bit * 8 + run length); return the state after and the stuff bits added."""
    last, run = state >> 3, state & 7
    stuffed = 0
    for position in reversed(range(count)):
        bit = bits >> position & 1
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuffed += 1
            last, run = 1 - last, 1
    return last << 3 | run, stuffed


_CRC = _crc_table()
_STUFF = tuple(tuple(_stuff(state, byte, 8) for byte in range(256)) for state in range(16))
_IDLE = 1 << 3
"""Before a frame the bus is recessive. With a run length of 0 the start bit is the first of its run."""


def frame_bits(identifier: int, data: bytes, length: int | None = None) -> int:
    """Return the number of bits of a frame, with stuff bits and the gap after it.

    Args:
        identifier: Identifier with the flags EXTENDED and REMOTE.
        data: Up to 8 bytes; empty for a remote frame.
        length: The length code, if it is not the number of bytes (a remote frame's).
    """
    code = len(data) if length is None else length
    remote = 1 if identifier & REMOTE else 0
    if identifier & EXTENDED:
        base, rest = identifier >> 18 & 0x7FF, identifier & 0x3FFFF
        head = (base << 2 | 3) << 25 | rest << 7 | remote << 6 | code
        head_bits = 39
    else:
        head = (identifier & 0x7FF) << 7 | remote << 6 | code
        head_bits = 19
    payload = b"" if remote else data
    stream = head << 8 * len(payload) | int.from_bytes(payload, "big")
    stream_bits = head_bits + 8 * len(payload)

    crc = 0
    for byte in stream.to_bytes((stream_bits + 7) // 8, "big"):  # leading zeros leave a CRC of zero as it is
        crc = (crc << 8 & 0x7FFF) ^ _CRC[crc >> 7 ^ byte]
    stream = stream << 15 | crc
    stream_bits += 15

    first = stream_bits % 8
    state, stuffed = _stuff(_IDLE, stream >> stream_bits - first, first)
    rest_bytes = stream_bits // 8
    for byte in (stream & (1 << 8 * rest_bytes) - 1).to_bytes(rest_bytes, "big"):
        state, more = _STUFF[state][byte]
        stuffed += more
    return stream_bits + stuffed + _TAIL_BITS


def fd_frame_bits(identifier: int, data: bytes) -> tuple[int, int]:
    """Return the parts of a frame of CAN FD at the bit rates of bus and data [bit], with stuff bits and the gap.

    The bit rate is switched. Checksum and stuff count have a fixed number of stuff bits, so their values do not matter.
    """
    code = FD_SIZES.index(len(data))
    if identifier & EXTENDED:
        base, rest = identifier >> 18 & 0x7FF, identifier & 0x3FFFF
        head, head_bits = (base << 2 | 3) << 22 | rest << 4 | 0b0101, 36  # RRS, FDF, res, BRS
    else:
        head, head_bits = (identifier & 0x7FF) << 5 | 0b00101, 17  # RRS, IDE, FDF, res, BRS
    state, in_head = _stuff(_IDLE, head, head_bits)
    state, stuffed = _stuff(state, code, 5)  # ESI and length
    for byte in data:
        state, more = _STUFF[state][byte]
        stuffed += more
    return head_bits + in_head + _TAIL_BITS, 5 + 8 * len(data) + stuffed + checksum_bits(len(data))


def arbitration(identifier: int) -> int:
    """Return the number that is compared on the wire; the lower one wins."""
    remote = 1 if identifier & REMOTE else 0
    if identifier & EXTENDED:
        return (identifier >> 18 & 0x7FF) << 21 | 3 << 19 | (identifier & 0x3FFFF) << 1 | remote
    return (identifier & 0x7FF) << 21 | remote << 20


@dataclass(frozen=True, slots=True)
class _Waiting:
    sender: Hashable
    frame: bytes
    arrived: float
    duration: float


class Wire:
    """Timing of one bus: the waiting frame with the lowest identifier is sent next.

    A frame that is being sent is not interrupted. Times [s] are those of one monotonic clock.
    """

    def __init__(self, bitrate: int, data_bitrate: int | None = None) -> None:
        self._bit, self._data_bit = 1.0 / bitrate, 1.0 / (data_bitrate or bitrate)
        self._waiting: list[tuple[int, int, _Waiting]] = []
        self._count = 0
        self._count_of: Counter[Hashable] = Counter()
        self._flying: _Waiting | None = None
        self._free_at = 0.0
        self.busy = 0.0
        """Total time during which the bus carried a frame [s]."""

    def __len__(self) -> int:
        return len(self._waiting)

    def waiting_of(self, sender: Hashable) -> int:
        """Return the number of a sender's waiting frames."""
        return self._count_of[sender]

    def push(self, now: float, sender: Hashable, identifier: int, data: bytes, length: int, frame: bytes) -> None:
        """Add a classic frame to the waiting frames."""
        self._add(identifier, _Waiting(sender, frame, now, frame_bits(identifier, data, length) * self._bit))

    def push_fd(self, now: float, sender: Hashable, identifier: int, data: bytes, frame: bytes) -> None:
        """Add a frame of CAN FD to the waiting frames."""
        at_bus, at_data = fd_frame_bits(identifier, data)
        self._add(identifier, _Waiting(sender, frame, now, at_bus * self._bit + at_data * self._data_bit))

    def _add(self, identifier: int, entry: _Waiting) -> None:
        self._count += 1
        self._count_of[entry.sender] += 1
        heapq.heappush(self._waiting, (arbitration(identifier), self._count, entry))

    def advance(self, now: float) -> list[tuple[object, bytes, float]]:
        """Return frames whose last bit has passed by now: sender, frame, and its end [s]."""
        done: list[tuple[object, bytes, float]] = []
        while True:
            if self._flying is None:
                if not self._waiting:
                    return done
                self._flying = heapq.heappop(self._waiting)[2]
                self._count_of[self._flying.sender] -= 1
                if not self._count_of[self._flying.sender]:
                    del self._count_of[self._flying.sender]
                start = max(self._free_at, self._flying.arrived)
                self._free_at = start + self._flying.duration
                self.busy += self._flying.duration
            if self._free_at > now:
                return done
            done.append((self._flying.sender, self._flying.frame, self._free_at))
            self._flying = None

    def due(self) -> float | None:
        """Return the end of the frame in flight [s]; None on an idle bus."""
        return self._free_at if self._flying is not None else None
