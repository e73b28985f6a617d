"""Opening of an interface by python-can, as a robot file describes its bus."""

from typing import Any

import can

from hal.config import BusConfig


def open_interface(config: BusConfig) -> can.BusABC:
    """Open the interface of a bus; it raises what the plugin of the interface raises."""
    fd: dict[str, Any] = {"fd": True, "data_bitrate": config.data_bitrate} if config.is_fd else {}
    return can.Bus(
        config.channel, config.interface, ignore_config=True, bitrate=config.bitrate, **{**fd, **config.options}
    )
