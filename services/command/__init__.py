"""The rules for who may move a robot: one lease, commands and targets that are on time, and one intake for both."""
