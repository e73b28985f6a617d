"""The paper's humanoid with tools (section III-C)."""
