"""Every speed and accuracy figure of the documentation, one command each."""
