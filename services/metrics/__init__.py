"""Metrics of running robots for Prometheus."""
