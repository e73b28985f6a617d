"""Counts to SI units: what a robot file says of it, and what was measured of one device."""
