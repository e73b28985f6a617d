"""Descent on the inputs or on z: losses, routes and the search for a solution (paper, II-G to II-J)."""
