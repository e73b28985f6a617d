"""Servo drives of CiA 402."""

from hal.drivers.cia402.drive import Cia402Drive

__all__ = ["Cia402Drive"]
