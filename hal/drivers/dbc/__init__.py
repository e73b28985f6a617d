"""Sensors and servos that a DBC file describes."""
