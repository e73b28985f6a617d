"""The live page: one more client of a robot, and a small web server that shows what it hears."""
