"""Simulated nodes whose frames a DBC file describes: a sensor and a servo, after the settings of a robot file."""
