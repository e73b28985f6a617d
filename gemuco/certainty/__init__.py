"""Certainty of estimates: an std for every sample, and a state with its reason."""

from gemuco.certainty.certainty import Certainty as Certainty
