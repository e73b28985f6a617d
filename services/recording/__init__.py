"""Recordings of all messages of a robot: writing, reading, replay, export."""
