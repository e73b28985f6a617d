"""Limits of commands, trips, watchdogs and the emergency stop."""
