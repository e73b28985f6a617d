"""Servo drives in MIT mode."""

from hal.drivers.mit.drive import MitDrive

__all__ = ["MitDrive"]
