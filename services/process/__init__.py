"""The parts of every service process: lock, session, loops, health, end."""
