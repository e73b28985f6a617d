"""Online update: recognition of p and the slow update of W (paper, II-F)."""
