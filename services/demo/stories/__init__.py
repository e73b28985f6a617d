"""The stories that `gemuco demo` can play, and their pictures."""
