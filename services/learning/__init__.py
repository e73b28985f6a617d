"""Collection of training data, and training of a model."""
