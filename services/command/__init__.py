"""Rules that decide which client may move a robot: the lease, the age of a request, and the intake of messages."""
