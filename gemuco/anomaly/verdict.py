"""Environment change or anomaly: the decision that the paper leaves open (II-K), by a test of another p."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from gemuco.adaption.innovation import Innovations
from gemuco.adaption.recognise import Prior, solve
from gemuco.anomaly.blame import suspects
from gemuco.anomaly.outside import outside
from gemuco.anomaly.window import window_score
from gemuco.schema import BodySchema, check_schema
from gemuco.signals import check_samples

HARMLESS = ("normal", "environment", "unknown", "outside")
"""With these verdicts nothing is wrong with the body, as far as is known."""
PLAUSIBLE = 3.0
"""A p of an environment is at most this far from the mean of the trained ones [their standard deviations]."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Judgement of a body by its last samples.

    Attributes:
        kind: `normal`; `environment` if another p explains the samples; `unknown` if this p, or the one in use, is
            beyond the trained ones, so that it explains these samples and says little of others; `outside` if the
            samples are outside of what was learned, and their errors as large as is to be expected there; `anomaly` if
            nothing explains them. Empty if no error can be judged.
        score: How far the samples are from normal under the p in use, as a share of what as many consecutive samples of
            a healthy body reach with the probability of a false alarm.
        explained: The same under the p that explains the samples best; equal to `score` if none was searched.
        bias: That p, shape (bias_size,); the one in use if none was searched.
        blamed: `signal.element` that is most likely wrong, or, if the kind is `outside`, furthest outside of its
            learned range; empty for other kinds.
    """

    kind: str
    score: float
    explained: float
    bias: np.ndarray
    blamed: str


def judge(schema: BodySchema, samples: Iterable[Mapping[str, np.ndarray]]) -> Verdict:
    """Judge whether samples are normal, of another condition, or an anomaly.

    If the samples are unlikely under the p in use, p is recognised anew from all of them. If they are normal under the
    result and it is like the trained ones, the environment has changed (a tool, a load, a grip) and an update of p is
    enough. Samples that no p explains are an anomaly, unless they are outside of what was learned and every element
    fits the others as well as can be expected there.

    Args:
        schema: A schema with statistics of prediction errors.
        samples: The last samples, oldest first, each signal -> measured array [its unit], shape (n,). All count alike,
            so they should begin when the score rose, and be about as far apart in time as those of the normal data.

    Raises:
        UnknownSignal: A name is not in the layout.
        WrongSize: An array does not have its signal's size.
    """
    check_schema(schema)
    check_samples(samples)
    rows = np.array([schema.normalise_one(sample) for sample in samples]).reshape(-1, schema.layout.size)
    score = window_score(schema, rows)
    if not np.isfinite(score):
        return Verdict("", score, score, schema.bias, "")
    prior = Prior.of(schema)
    if score <= 1.0:
        is_beyond = len(schema.bias) > 0 and prior.is_beyond(schema.bias.astype(float))
        return Verdict("unknown" if is_beyond else "normal", score, score, schema.bias, "")
    bias, explained = schema.bias, score
    if len(schema.bias):
        bias, _ = solve(schema, Innovations(schema), prior, rows, schema.bias.astype(float))
        explained = window_score(schema.with_bias(bias), rows)
        if explained <= 1.0 and prior.between(bias, prior.mean) <= PLAUSIBLE:
            return Verdict("unknown" if prior.is_beyond(bias) else "environment", score, explained, bias, "")
    furthest = outside(schema, rows)
    if furthest:
        return Verdict("outside", score, explained, bias, furthest)
    return Verdict("anomaly", score, explained, bias, suspects(schema, rows)[0].name)
