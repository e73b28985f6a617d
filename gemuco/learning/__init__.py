"""Training of the network from episodes (paper, II-D)."""
