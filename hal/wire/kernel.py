"""Kernel settings of a CAN interface: buffers, filters and frame counter."""

import os
import socket
import struct
from pathlib import Path

import can

from hal.wire.routes import Routes
from hal.wire.send import PAUSE, PAUSES

IN_FLIGHT = 64
"""A socket may hold at most this number of unsent frames, because they cannot be withdrawn."""
FRAME_MEMORY = 768
"""Linux counts this memory for one frame in the buffer of a socket [byte]."""
RECEIVE_MEMORY = 4 << 20
"""The receive buffer has this size [byte]: 5000 frames, half a second of a full bus; the kernel may grant less."""
NETWORK = Path("/sys/class/net")

_SO_RCVBUFFORCE = 33
_TIMEVAL = struct.Struct("@ll")


def set_buffers(interface: can.BusABC) -> None:
    """Set a large receive buffer and a small send buffer, if the interface has a socket.

    A TCP socket with a full buffer fails after the pauses of one cycle.
    """
    try:
        handle = os.dup(interface.fileno())
    except (NotImplementedError, AttributeError, ValueError, OSError):
        return
    try:
        link = socket.socket(fileno=handle)
    except OSError:  # such as a serial line
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
    """Filters and frame counter of a SocketCAN interface; without effect for other interfaces.

    Filtered frames load the bus too: they are the difference of the kernel's count and the received frames.
    """

    def __init__(self, interface: str, channel: str, network: Path = NETWORK) -> None:
        """Prepare.

        Args:
            interface: Kind of the interface, as named by python-can.
            channel: Channel of the interface.
            network: Folder in which Linux describes its interfaces.
        """
        self._filters = interface == "socketcan"
        folder = network / channel
        # On vcan our own frames count as received; only an adapter has a device.
        self._count = folder / "statistics" / "rx_packets" if self._filters and (folder / "device").exists() else None

    def filter(self, interface: can.BusABC, routes: Routes) -> None:
        """Filter frames without a subscriber in the kernel; filters of python-can cost more than they save."""
        if self._filters:
            interface.set_filters(routes.filters())  # type: ignore[arg-type]

    def received(self) -> int | None:
        """Return the number of frames that the interface received since boot; None if they are not counted."""
        if self._count is None:
            return None
        try:
            return int(self._count.read_text())
        except (OSError, ValueError):  # unplugged
            return None
