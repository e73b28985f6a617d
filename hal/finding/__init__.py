"""Tools for operators: scan of a bus, decoding of frames, checks of a robot, and measurements for a calibration."""
