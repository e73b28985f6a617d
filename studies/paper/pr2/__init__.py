"""The paper's arm with seven joints and a duster (section III-A)."""
