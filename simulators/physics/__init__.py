"""Rigid bodies by one of two engines, PyBullet or MuJoCo, behind the same classes."""
