"""The paper's muscle-driven arm (section III-B)."""
