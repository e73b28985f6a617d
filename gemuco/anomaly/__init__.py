"""Anomaly detection: prediction errors, their score, the blamed element and the verdict (paper, II-K)."""
