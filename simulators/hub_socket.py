"""Socket of a hub channel, and the records that pass through it."""

import os
import re
import socket
import struct
from pathlib import Path

import can

from hal.own_folder import NotOwnFolder, own_folder

BUSES = "GEMUCO_BUSES"
"""This variable names a folder for the sockets of hub channels that programs of several users share."""
RECORD, RECORD_FD = struct.Struct("<IB3xd8s"), struct.Struct("<IB3xd64s")
"""A record holds identifier with flags, length with the flag `IS_FD`, time stamp [s since 1970] and data. On a channel
for CAN FD every frame has the larger record."""
IS_FD = 0x80
RECORDS = 128
"""A packet has at most this number of records."""
HELLOS = {b"gemuco hub 1": RECORD, b"gemuco hub 1 fd": RECORD_FD}
"""One of these is the first packet from the server, and says which records pass. The program receives every frame after
it."""


def socket_path(channel: str) -> Path:
    """Return the path of a channel's socket; an absolute path is taken as it is.

    Raises:
        can.CanInitializationError: The name cannot be a file name, or is too long for a socket.
    """
    if channel.startswith("/"):
        path = Path(channel)
    elif re.fullmatch(r"[\w.-]+", channel):
        path = _folder() / f"{channel}.can"
    else:
        raise can.CanInitializationError(
            f"'{channel}' is not the name of a hub channel: use letters, digits, '_', '-', '.', or an absolute path."
        )
    if len(os.fsencode(path)) > 107:
        raise can.CanInitializationError(f"The socket path '{path}' is longer than the 107 bytes that Linux allows.")
    return path


def _folder() -> Path:
    chosen = os.environ.get(BUSES)
    if chosen:
        return Path(chosen)
    try:
        return own_folder()
    except (NotOwnFolder, OSError) as error:
        raise can.CanInitializationError(f"There is no folder for hub channels: {error}") from None


def is_trusted(link: socket.socket) -> bool:
    """Whether the peer of a socket is a program of this user or of root, or channels are shared on purpose."""
    _, user, _ = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return BUSES in os.environ or user in (0, os.geteuid())


def mode_of(path: Path) -> int:
    """Return the permissions of a channel's socket: for this user alone, or for the group that shares the folder."""
    return 0o660 if os.environ.get(BUSES) == str(path.parent) else 0o600


def channels() -> list[str]:
    """Return names of the channels whose sockets exist, served or not."""
    return [path.stem for path in sorted(_folder().glob("*.can"))]
