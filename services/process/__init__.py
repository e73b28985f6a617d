"""What every process has: lock, session, loops in time, health, an end."""
