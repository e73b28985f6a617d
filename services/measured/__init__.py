"""Measured data from files: their description in YAML, its draft, and the episodes that are read by it."""
