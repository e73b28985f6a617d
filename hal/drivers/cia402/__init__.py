"""Servo drives of profile CiA 402."""
