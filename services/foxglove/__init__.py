"""Robots and recordings in Foxglove."""
