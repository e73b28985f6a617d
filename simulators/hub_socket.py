"""Where the socket of a hub channel lies, and what passes through it."""

import os
import re
import struct
from pathlib import Path

import can

RECORD = struct.Struct("<IB3xd8s")
"""Identifier with flags, length, time stamp [s since 1970], data."""
PACKET = 128 * RECORD.size
"""Most bytes in one packet."""
HELLO = b"gemuco hub 1"
"""First packet from the server: from here on the program misses no frame."""


def socket_path(channel: str) -> Path:
    """Where the socket of a channel lies; an absolute path is taken as it is.

    Raises:
        can.CanInitializationError: The name cannot be a file name, or is too long for a socket.
    """
    if channel.startswith("/"):
        path = Path(channel)
    elif re.fullmatch(r"[\w.-]+", channel):
        path = _folder() / f"{channel}.can"
    else:
        raise can.CanInitializationError(
            f"Channel '{channel}' is no name for a hub: letters, digits, '_', '-' and '.' only, or an absolute path."
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
    """Names of the channels whose sockets exist, served or not."""
    return [path.stem for path in sorted(_folder().glob("*.can"))]
