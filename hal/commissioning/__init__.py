"""Commissioning of a CANopen node before its first cycle: identity, configuration and its verification."""
