"""What the kernel can be asked for a CAN interface: room, filters, and how many frames there were."""

import os
import socket
import struct
from pathlib import Path

import can

from hal.wire.routes import Routes
from hal.wire.send import PAUSE, PAUSES

IN_FLIGHT = 64
"""Frames that a socket may have taken and not yet sent: these cannot be taken back."""
FRAME_MEMORY = 768
"""What Linux counts for one frame in a socket's buffer [byte]."""
RECEIVE_MEMORY = 4 << 20
"""For frames that wait to be read [byte]: 5000, half a second of a full bus; the kernel may grant less."""
NETWORK = Path("/sys/class/net")

_SO_RCVBUFFORCE = 33
_TIMEVAL = struct.Struct("@ll")


def set_buffers(interface: can.BusABC) -> None:
    """Give an interface's socket, if it has one, much room for what is received and little for what is sent.

    A TCP socket that takes nothing gives up after the pauses of one cycle.
    """
    try:
        handle = os.dup(interface.fileno())
    except (NotImplementedError, AttributeError, ValueError, OSError):
        return
    try:
        link = socket.socket(fileno=handle)
    except OSError:  # a serial line, for one
        os.close(handle)
        return
    with link:
        try:
            link.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_MEMORY)
        except OSError:  # without CAP_NET_ADMIN the kernel grants up to net.core.rmem_max
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_MEMORY)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, IN_FLIGHT * FRAME_MEMORY // 2)  # the kernel doubles it
        seconds, fraction = divmod(round(PAUSES * PAUSE * 1e6), 1_000_000)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TIMEVAL.pack(seconds, fraction))


class Kernel:
    """The Linux kernel's view of one interface; of an interface that is not its own it knows nothing.

    What it keeps away on our behalf loads the bus all the same, so those frames are counted by the difference.
    """

    def __init__(self, interface: str, channel: str, network: Path = NETWORK) -> None:
        """Prepare.

        Args:
            interface: python-can's name of the kind.
            channel: Of the interface.
            network: Where Linux tells of its interfaces.
        """
        self._filters = interface == "socketcan"
        folder = network / channel
        # On vcan our own frames count as received; only an adapter has a device.
        self._count = folder / "statistics" / "rx_packets" if self._filters and (folder / "device").exists() else None

    def filter(self, interface: can.BusABC, routes: Routes) -> None:
        """Keep away what nobody wants; python-can's own filters would cost more than they save."""
        if self._filters:
            interface.set_filters(routes.filters())  # type: ignore[arg-type]

    def received(self) -> int | None:
        """Frames that the interface ever received; None if nobody counts them."""
        if self._count is None:
            return None
        try:
            return int(self._count.read_text())
        except (OSError, ValueError):  # unplugged
            return None
