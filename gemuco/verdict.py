"""Environment change or anomaly: the decision that the paper leaves open (II-K), by whether another p explains it."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is the matter with a body, judged by its last samples.

    Attributes:
        kind: `normal`; `environment` if the body is in another condition that a p describes; `anomaly` if none does;
            empty without normal data or without any sample to judge.
        score: Root mean square of the samples' anomaly scores, as a share of each sample's threshold, under the p in
            use.
        explained: The same under the p that explains the samples best; equal to `score` without parametric bias.
        bias: That p, shape (bias_size,).
        blamed: The element, `signal.element`, whose removal explains the samples best; empty unless an anomaly.
    """

    kind: str
    score: float
    explained: float
    bias: np.ndarray
    blamed: str
