"""A CANopen node before its first cycle: asked who it is, told what to send, and read back."""
