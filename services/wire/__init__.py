"""Communication: keys, records, streams, queries and sessions; no robot, no model."""
