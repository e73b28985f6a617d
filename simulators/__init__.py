"""The other end of the wire: physics, simulated nodes, the simulated bus."""
