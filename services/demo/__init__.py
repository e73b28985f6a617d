"""Stories that a simulated robot plays, and their pictures."""
