"""The process that owns a robot's hardware, what stands in for it, and its tools."""
