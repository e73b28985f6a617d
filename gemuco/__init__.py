"""The model: a body schema on plain arrays, with no robot, no bus and no clock in it."""
