"""Socket of a hub channel, and the records that pass through it."""

import os
import re
import struct
from pathlib import Path

import can

RECORD = struct.Struct("<IB3xd8s")
"""A record holds identifier with flags, length, time stamp [s since 1970] and data."""
PACKET = 128 * RECORD.size
"""A packet has at most this many bytes."""
HELLO = b"gemuco hub 1"
"""This is the first packet from the server. The program receives every frame after it."""


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
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_dir():
        return Path(runtime) / "gemuco"
    return Path(f"/tmp/gemuco-{os.getuid()}")


def channels() -> list[str]:
    """Return names of the channels whose sockets exist, served or not."""
    return [path.stem for path in sorted(_folder().glob("*.can"))]
