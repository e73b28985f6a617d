"""Sizes and longest lengths of frames, of classic CAN and of CAN FD (ISO 11898-1:2015).

A classic frame has 44 bits beside the data with an 11-bit identifier, 64 with a 29-bit identifier. In 34 or 54 of these
bits and in the data, every fourth bit after the first may be followed by a stuff bit. The space between frames has 3
bits. A frame of CAN FD is sent at the bit rate of the bus but for its middle part, from the bit after the switch to the
end of the checksum, which is sent at the bit rate of its data.
"""

from typing import NamedTuple

LONGEST, LONGEST_FD = 8, 64
"""A classic frame and one of CAN FD have at most this number of data bytes."""
FD_SIZES = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""A frame of CAN FD has one of these numbers of data bytes."""
SHORT_CHECKSUM = 16
"""Up to this number of data bytes the checksum of a frame of CAN FD has 17 bits, above 21."""
TAIL = 13
"""Checksum delimiter, acknowledge slot and delimiter, end of frame and the space between frames [bit], without stuff
bits; all of them at the bit rate of the bus."""


class Frames(NamedTuple):
    """Frames that a device sends or receives.

    Attributes:
        size: Data bytes; on a serial line its bytes.
        rate: Frames per second [Hz].
        is_extended: Whether the identifier has 29 bits.
        is_fd: Whether they are frames of CAN FD.
    """

    size: int
    rate: float
    is_extended: bool = False
    is_fd: bool = False


def fd_size(length: int) -> int:
    """Return the number of data bytes of the shortest frame of CAN FD that holds this number of bytes.

    Raises:
        ValueError: There are more bytes than in the longest one.
    """
    if length > LONGEST_FD:
        raise ValueError(f"{length} bytes do not fit into a frame of CAN FD, which has at most {LONGEST_FD}.")
    return next(size for size in FD_SIZES if size >= length)


def frame_bits(size: int, is_extended: bool = False) -> int:
    """Return the longest length of a classic frame with `size` data bytes [bit], with stuff bits and space."""
    stuffed = (54 if is_extended else 34) + 8 * size
    return TAIL + stuffed + (stuffed - 1) // 4


def checksum_bits(size: int) -> int:
    """Return the length of stuff count and checksum of a frame of CAN FD [bit], with their fixed stuff bits."""
    bits = 4 + (17 if size <= SHORT_CHECKSUM else 21)
    return bits + -(-bits // 4)


def fd_bits(size: int, is_extended: bool = False) -> tuple[int, int]:
    """Return the longest parts of a frame of CAN FD with `size` data bytes at the bit rates of bus and data [bit]."""
    head, middle = 36 if is_extended else 17, 5 + 8 * size
    in_head = (head - 1) // 4
    return head + in_head + TAIL, middle + (head + middle - 1) // 4 - in_head + checksum_bits(size)


class FrameLengths:
    """Longest lengths of all frames of one bus, in bits at its bit rate.

    Attributes:
        classic: Lengths of classic frames with an 11-bit identifier, by data bytes.
        extended: Those with a 29-bit identifier.
        is_fd: Whether the bus has frames of CAN FD too.
    """

    def __init__(self, bitrate: int, data_bitrate: int | None) -> None:
        """Prepare for bit rates [bit/s] of a bus; without one of the data it has classic frames only."""
        self.classic = tuple(frame_bits(size) for size in range(LONGEST + 1))
        self.extended = tuple(frame_bits(size, is_extended=True) for size in range(LONGEST + 1))
        self.is_fd = data_bitrate is not None
        share = bitrate / (data_bitrate or bitrate)
        self._fd = {
            (size, is_extended): at_bus + share * at_data
            for size in FD_SIZES
            for is_extended in (False, True)
            for at_bus, at_data in [fd_bits(size, is_extended)]
        }

    def fits(self, size: int, is_fd: bool) -> bool:
        """Whether the bus has frames with `size` data bytes, of CAN FD or classic ones."""
        return self.is_fd and size in FD_SIZES if is_fd else size <= LONGEST

    def of(self, size: int, is_extended: bool, is_fd: bool) -> float:
        """Return the length of a frame that `fits`."""
        return self._fd[size, is_extended] if is_fd else (self.extended if is_extended else self.classic)[size]


CLASSIC = FrameLengths(1_000_000, None)
"""Lengths of the frames of a bus without CAN FD, at any bit rate."""
