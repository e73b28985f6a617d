"""Accuracy of models on bodies that are simulated, measured or made up."""
