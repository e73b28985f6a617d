"""Timing, cost and endurance of the running processes."""
