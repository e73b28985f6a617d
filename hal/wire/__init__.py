"""One CAN bus: interface, state, sending, receiving, time of arrival and load."""
