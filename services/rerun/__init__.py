"""A robot in rerun: the same facts as in Foxglove, as a file or in an open viewer."""
