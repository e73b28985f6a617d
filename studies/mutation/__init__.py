"""Mutation probe: the share of small changes of the code that the fast tests notice."""
