"""Simulated servo drives of profile CiA 402."""
