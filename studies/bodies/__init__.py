"""Bodies, real and simulated, that several studies judge."""
