"""The hardware: buses, devices, limits and time. Knows nothing of learning or of the network."""
