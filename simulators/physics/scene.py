"""Numbers that both engines share."""

STEP = 0.0025
"""The physics of an arm advances in steps of this duration [s]."""
FLOOR = 0.02
"""The floor is this far below what stands still, and below the arm in its first posture [m]."""
