"""Finding out: who is on a bus, what frames mean, what is wrong with a robot, and what a device really measures."""
