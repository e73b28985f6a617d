"""What was said on the wire, in files: written, read, replayed, exported."""
