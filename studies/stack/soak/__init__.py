"""Endurance of a whole simulated robot while everything around it breaks."""
