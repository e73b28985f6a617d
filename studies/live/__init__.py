"""The whole model service in simulated time: all its loops at their own rates, fed by hand, hours in minutes."""
