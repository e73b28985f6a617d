"""Files that people write: their text, and their mistakes in a sentence."""
