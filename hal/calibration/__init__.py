"""Conversion of counts to SI units, fits of calibrations, and their file."""
