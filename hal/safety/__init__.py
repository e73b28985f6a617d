"""One limit per class, and what happens when a limit is not enough: trips and the emergency stop."""
