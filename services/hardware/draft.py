"""`gemuco init FOLDER` and `gemuco init --scan can0`: a robot file of the devices that there are."""

import re
from pathlib import Path

from hal.config import BusConfig
from hal.finding.draft.draft import Draft, draft_bus, draft_folder
from hal.finding.scan import scan
from hal.finding.serial_scan import scan_line
from hal.finding.tap import Tap
from hal.line import SERIAL
from services.model.artifacts import SHIPPED


def bus_of(channel: str, bitrate: int) -> BusConfig:
    """Return the bus of a channel of SocketCAN, or of `INTERFACE:CHANNEL`, with a bit rate [bit/s]."""
    interface, colon, place = channel.rpartition(":")
    return BusConfig(interface=interface if colon else "socketcan", channel=place, bitrate=bitrate)


def draft_devices(source: Path | None, channel: str | None, bitrate: int, name: str | None, file: Path) -> Draft:
    """Return a robot file of the devices in a folder of vendors' files, or on a bus.

    Args:
        source: Folder with EDS, DCF and DBC files; None without one.
        channel: Channel of SocketCAN, `INTERFACE:CHANNEL` of python-can, or `serial:/dev/ttyACM0` for a line of servos,
            to scan; None to use the folder only.
        bitrate: Bit rate of the bus [bit/s].
        name: Name of the robot; None for that of the robot file.
        file: Robot file to be written.

    Raises:
        ConfigError: There is no device with a driver.
        BusGone: The bus cannot be opened, or failed.
    """
    robot = name or robot_name(file.stem)
    if channel is None:
        assert source is not None
        return draft_folder(source, robot, file.parent, SHIPPED)
    bus = bus_of(channel, bitrate)
    place = bus.channel
    label = re.sub(r"\W+", "_", Path(place).name) or "can0"
    if bus.interface in SERIAL:
        result = scan_line(label, bus)
    else:
        with Tap(label, bus) as tap:
            result = scan(tap)
    real = f"interface: {bus.interface}, channel: {place}"
    return draft_bus(result, real, bitrate, source, robot, file.parent, SHIPPED)


def robot_name(text: str) -> str:
    """Return a name of a robot made of a text: lower-case letters, digits and underscores."""
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_") or "robot"
    return name if name[0].isalpha() else f"robot_{name}"
