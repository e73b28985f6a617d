"""`gemuco init FOLDER` and `gemuco init --scan can0`: a robot file of the devices that there are."""

import re
from pathlib import Path

from hal.config import BusConfig
from hal.finding.draft.draft import Draft, draft_bus, draft_folder
from hal.finding.scan import scan
from hal.finding.serial_scan import scan_line
from hal.finding.tap import Tap
from hal.line import SERIAL
from services.errors import BadArguments
from services.model.artifacts import SHIPPED


def bus_of(channel: str, bitrate: int, data_bitrate: int | None = None) -> BusConfig:
    """Return the bus of a channel of SocketCAN, or of `INTERFACE:CHANNEL`, with bit rates [bit/s].

    Raises:
        BadArguments: The bit rate of the data is below that of the bus.
    """
    interface, colon, place = channel.rpartition(":")
    return bus_with(interface if colon else "socketcan", place, bitrate, data_bitrate)


def bus_with(interface: str, channel: str, bitrate: int, data_bitrate: int | None) -> BusConfig:
    """Return the bus of an interface and a channel, otherwise as `bus_of`."""
    if data_bitrate is not None and data_bitrate < bitrate:
        raise BadArguments(
            f"--data-bitrate {data_bitrate} is below --bitrate {bitrate}; data of CAN FD are not slower."
        )
    return BusConfig(interface=interface, channel=channel, bitrate=bitrate, data_bitrate=data_bitrate)


def draft_devices(source: Path | None, bus: BusConfig | None, name: str | None, file: Path) -> Draft:
    """Return a robot file of the devices in a folder of vendors' files, or on a bus.

    Args:
        source: Folder with EDS, DCF and DBC files; None without one.
        bus: The bus to scan, or the line of servos; None to use the folder only.
        name: Name of the robot; None for that of the robot file.
        file: Robot file to be written.

    Raises:
        ConfigError: There is no device with a driver.
        BusGone: The bus cannot be opened, or failed.
    """
    robot = name or robot_name(file.stem)
    if bus is None:
        assert source is not None
        return draft_folder(source, robot, file.parent, SHIPPED)
    place = bus.channel
    label = re.sub(r"\W+", "_", Path(place).name) or "can0"
    if bus.interface in SERIAL:
        result = scan_line(label, bus)
    else:
        with Tap(label, bus) as tap:
            result = scan(tap)
    real = f"interface: {bus.interface}, channel: {place}"
    return draft_bus(result, real, bus, source, robot, file.parent, SHIPPED)


def robot_name(text: str) -> str:
    """Return a name of a robot made of a text: lower-case letters, digits and underscores."""
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_") or "robot"
    return name if name[0].isalpha() else f"robot_{name}"
