"""Sensors and servos that a DBC file describes."""

from hal.drivers.dbc.sensor import DbcNode
from hal.drivers.dbc.servo import DbcServo

__all__ = ["DbcNode", "DbcServo"]
