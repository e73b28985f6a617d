"""Pictures of a body schema and of its estimates, as matplotlib Axes.

Each function draws into the Axes `axes`, or into a figure of its own, and returns the Axes. Needs the extra `train`.
"""

from gemuco.plot.model import bias_map, errors, structure
from gemuco.plot.samples import anomaly, estimate

__all__ = ["anomaly", "bias_map", "errors", "estimate", "structure"]
