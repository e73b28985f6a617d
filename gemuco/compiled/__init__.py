"""Compiled code of every tick, without interpreter or GIL. `gemuco.layers` has the same in plain numpy."""
