"""The std of estimates, sample by sample: its calibration, the state of an estimate with its reason, and widening."""
