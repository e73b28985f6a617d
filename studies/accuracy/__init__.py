"""Accuracy of models on simulated, measured and synthetic bodies."""
