"""What each simulated robot is made of."""
