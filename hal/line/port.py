"""Port of a serial line: a device file of an adapter, or the pseudo-terminal of simulated servos."""

import os
import re
import select
from pathlib import Path
from typing import Any

from hal.errors import BusGone, ConfigError
from hal.own_folder import NotOwnFolder, own_folder

SERIAL = ("serial", "pty")
"""Interfaces of serial lines: an adapter, and simulated servos of another process."""
FOLDER = "GEMUCO_BUSES"
"""This variable names a folder for the links to pseudo-terminals that programs of several users share."""
MOST_READ = 4096
MOST_DRAINED = 8
"""At most this number of readings is dropped at once; a line that never is quiet has other faults."""
WRITE_TIMEOUT = 0.1
"""An adapter that takes no bytes for this time [s] is gone."""


def path_of(interface: str, channel: str) -> Path:
    """Return the device file of a line; a pseudo-terminal has a link of its name in the folder of this user.

    Raises:
        ConfigError: The name of the channel cannot be a file name.
        BusGone: There is no folder for links.
    """
    if interface == "serial" or channel.startswith("/"):
        return Path(channel)
    if not re.fullmatch(r"[\w.-]+", channel):
        raise ConfigError(f"'{channel}' is not the name of a pty channel: use letters, digits, '_', '-' or '.'.")
    try:
        return (Path(os.environ[FOLDER]) if os.environ.get(FOLDER) else own_folder()) / f"{channel}.tty"
    except (NotOwnFolder, OSError) as error:
        raise BusGone(f"There is no folder for pty channels: {error}") from None


class Port:
    """Open port, for this program alone."""

    def __init__(self, interface: str, channel: str, bitrate: int) -> None:
        """Open the device file.

        Raises:
            BusGone: It does not exist, another program has it, or pyserial is missing.
        """
        try:
            import serial  # an extra: most robots have CAN
        except ImportError:
            raise BusGone("A serial line needs the package pyserial: pip install 'gemuco[serial]'.") from None
        path = path_of(interface, channel)
        if not path.exists():
            advice = "Is the adapter plugged in?" if interface == "serial" else "Does `gemuco simulate` run?"
            raise BusGone(f"There is no '{path}'. {advice}")
        try:
            self._serial: Any = serial.Serial(
                str(path), bitrate, timeout=0, write_timeout=WRITE_TIMEOUT, exclusive=True
            )
        except (serial.SerialException, ValueError, OSError) as error:
            raise BusGone(f"'{path}' does not open: {error}") from None
        self._file = self._serial.fileno()
        self.is_slow = interface == "serial" and not self._hurry()
        """Whether the adapter may keep received bytes for milliseconds before it passes them on."""

    def _hurry(self) -> bool:
        """Ask the driver to pass bytes on at once; return whether it can (FTDI; adapters of class CDC always do)."""
        try:
            self._serial.set_low_latency_mode(True)
        except (OSError, ValueError, NotImplementedError):
            return "ttyACM" in os.path.realpath(self._serial.port)
        return True

    def write(self, packet: bytes) -> None:
        """Send bytes.

        Raises:
            BusGone: The adapter does not take them.
        """
        try:
            self._serial.write(packet)
        except OSError as error:  # pyserial's exceptions are of this class
            raise BusGone(f"The adapter takes no bytes: {error}") from None

    def read(self, timeout: float) -> bytes:
        """Return the bytes that came; none after `timeout` [s].

        Raises:
            BusGone: The adapter is gone.
        """
        try:
            ready, _, _ = select.select([self._file], [], [], max(timeout, 0.0))
            if not ready:
                return b""
            received = os.read(self._file, MOST_READ)
        except (OSError, ValueError) as error:
            raise BusGone(f"The adapter is gone: {error}") from None
        if not received:
            raise BusGone("The adapter is gone: end of file.")
        return received

    def drain(self) -> None:
        """Drop bytes that wait: the late answer to an earlier request.

        Raises:
            BusGone: The adapter is gone.
        """
        for _ in range(MOST_DRAINED):
            if not self.read(0.0):
                return

    def close(self) -> None:
        """Close the file. Safe if the adapter is gone."""
        self._serial.close()
