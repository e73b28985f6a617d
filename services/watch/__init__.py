"""State of running robots for the page and both kinds of `gemuco top`, and the one judge of what is wrong with them."""
