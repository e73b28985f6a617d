"""Compiled code of every tick, without interpreter, GIL or torch. `gemuco.layers` has the same in plain numpy."""
