"""Status packet of a servo on a serial line, and the parser of such packets, whatever the protocol."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

MOST_WAITING = 4096
"""More unread bytes than this are no packet of a servo, and are dropped."""
MOST_SENT = 8
"""This number of sent packets is kept, to recognize them if they come back."""


@dataclass(frozen=True, slots=True)
class Status:
    """Answer of one servo.

    Attributes:
        node: Id of the servo.
        error: Error byte as sent.
        data: Parameters; for a read, the registers.
    """

    node: int
    error: int
    data: bytes


Cut = Callable[[bytearray], tuple[int, Status | None, bool]]
"""Function that returns the bytes to drop from the beginning, the status that they are, and whether they are
malformed. No bytes: more must come first."""


class StatusReader:
    """Parser of a stream of bytes; noise before and between packets is skipped and counted."""

    def __init__(self, cut: Cut) -> None:
        """Use the function `cut` of a protocol."""
        self.malformed = 0
        """Number of packets with a wrong checksum or length, and of runs of noise."""
        self.echoes = 0
        """Number of sent packets that came back, as some adapters do it."""
        self._cut = cut
        self._bytes = bytearray()
        self._sent: deque[bytes] = deque(maxlen=MOST_SENT)

    def clear(self) -> None:
        """Forget the beginning of a packet, before a new request."""
        self._bytes.clear()

    def sent(self, packet: bytes) -> None:
        """Note a packet that was sent, which is no answer if it comes back."""
        self._sent.append(packet)

    def feed(self, received: bytes) -> list[Status]:
        """Return the packets that end in `received` [bytes]."""
        waiting = self._bytes
        waiting += received
        packets: list[Status] = []
        while waiting:
            echo = next((one for one in self._sent if one[: len(waiting)] == waiting[: len(one)]), None)
            if echo is not None:
                if len(waiting) < len(echo):
                    break
                del waiting[: len(echo)]
                self._sent.remove(echo)
                self.echoes += 1
                continue
            used, status, is_malformed = self._cut(waiting)
            self.malformed += is_malformed
            if status is not None:
                packets.append(status)
            if not used:
                break
            del waiting[:used]
        if len(waiting) > MOST_WAITING:
            self.malformed += 1
            waiting.clear()
        return packets


class Packets(Protocol):
    """Module of one protocol, such as `hal.protocols.feetech`."""

    NAME: str
    OVERHEAD: int
    HIGHEST_NODE: int

    def ping(self, node: int) -> bytes:
        """Return the packet that asks whether a servo is there."""
        ...

    def read(self, node: int, address: int, size: int) -> bytes:
        """Return the packet that reads registers of one servo."""
        ...

    def write(self, node: int, address: int, data: bytes) -> bytes:
        """Return the packet that writes registers of one servo."""
        ...

    def sync_read(self, nodes: Sequence[int], address: int, size: int) -> bytes:
        """Return the packet that reads the same registers of several servos."""
        ...

    def sync_write(self, address: int, data: Mapping[int, bytes]) -> bytes:
        """Return the packet that writes the same registers of several servos."""
        ...

    def reader(self) -> StatusReader:
        """Return a parser of status packets."""
        ...
