"""From a robot that moves to a model of it."""
