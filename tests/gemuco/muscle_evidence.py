"""Evidence against a joint and the two sensors of a muscle, as the search for a cause gets it."""

import numpy as np

from gemuco.trust.evidence import Evidence

SIZE, JOINT, TENSION, LENGTH, OTHER = 12, 0, 3, 8, 9
MUSCLE = frozenset({TENSION, LENGTH})


def evidence(**strength: float) -> Evidence:
    """Return evidence against joint, tension and length; 80 is an alarm."""
    columns = {"joint": JOINT, "tension": TENSION, "length": LENGTH}
    against, zero = np.zeros(SIZE), np.zeros(SIZE, bool)
    against[[columns[name] for name in strength]] = list(strength.values())
    return Evidence(against / 80.0, against, np.full(SIZE, 5), np.zeros(SIZE), zero, zero, 1.0)
