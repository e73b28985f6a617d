"""Servos on a serial line."""

from hal.drivers.serial.dynamixel import DynamixelServo
from hal.drivers.serial.feetech import FeetechServo

__all__ = ["DynamixelServo", "FeetechServo"]
