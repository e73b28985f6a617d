"""Bytes to frozen dataclasses and back, one standard per file, no input or output."""
