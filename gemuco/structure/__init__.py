"""Determination of inputs, outputs and feasible masks from data (paper, II-E)."""
