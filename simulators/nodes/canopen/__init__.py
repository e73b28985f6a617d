"""Simulated CANopen nodes: what every node has, and the sensors."""
