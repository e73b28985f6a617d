"""Division of recorded data into training and held-out data: blocks of time, gaps, and repeated motions."""
