"""Live page of a robot: a client and a small web server."""
