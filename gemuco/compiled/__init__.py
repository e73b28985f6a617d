"""What runs in every tick, compiled: no interpreter, no GIL, no torch. `gemuco.layers` is the same in plain numpy."""
