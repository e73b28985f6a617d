"""Trust: which measured elements the others contradict, for how long, and what is wrong with them."""
