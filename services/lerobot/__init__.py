"""Recordings as datasets of LeRobot, and such datasets as measured data."""
