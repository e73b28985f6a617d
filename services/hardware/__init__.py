"""The hardware process of a robot, its simulated replacement, and its tools."""
