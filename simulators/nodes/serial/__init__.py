"""Simulated servos on a serial line, written from the makers' documents; no code is shared with the drivers."""
