"""One CAN bus: opening it, its state, what goes out, what comes in and when it came, and whether it all fits."""
