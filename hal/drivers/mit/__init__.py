"""Servo drives in MIT mode."""
