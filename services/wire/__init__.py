"""What travels: keys, records, streams, questions and sessions; no robot, no model."""
