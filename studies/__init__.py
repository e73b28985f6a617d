"""The paper's experiments, peers side by side, speed: programs that prove figures and run beside no robot."""
