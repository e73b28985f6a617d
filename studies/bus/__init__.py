"""Cost of frames, drivers, HAL and simulated nodes."""
