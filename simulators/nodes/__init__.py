"""Simulated CAN nodes, each with its own object dictionary."""
