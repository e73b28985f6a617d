"""One serial line with servos: its port, its thread and its cycle."""

from hal.line.line import SerialLine
from hal.line.port import SERIAL

__all__ = ["SERIAL", "SerialLine"]
