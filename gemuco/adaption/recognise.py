"""Recognition of p from samples (paper, usage (d), done with second-order information instead of gradient steps).

`Kalman` is a bank of extended Kalman filters, each with another time of the last change of the body (Bayesian change
point detection): at every sample a new one begins from the spread of the trained p, and each is weighted by how well it
predicted the samples since. A tool that was put down is recognised as soon as the evidence of new filters outweighs the
old ones, at once if one sample is decisive, else after several; without a change nothing is forgotten. The errors are
taken as t-distributed, so that a single outlier has little effect.

`GaussNewton` minimises the errors over the newest samples of a window from the same prior, without further memory.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gemuco.adaption.innovation import Innovations
from gemuco.compiled import bank, beliefs
from gemuco.schema import BodySchema

HAZARD = 0.01
"""The body changes with this probability per sample."""
BANK = 8
"""At most this many filters without a known condition are kept."""
DRIFT = 0.01
"""p drifts by this share of the prior's standard deviation per sample."""
TRUST = 0.5
"""The p in use when recognition begins is right with this probability."""
FREEDOM = 8.0
"""The errors' t-distribution has this many degrees of freedom."""
NARROW = 0.05
"""The standard deviation of p within a known condition is this share of the prior's."""
FAMILIAR = 0.9
"""After a change the body is in a known condition with this probability."""
FAINTEST = -60.0
"""The logarithm of a weight relative to the largest is at least this, so that no condition becomes impossible."""
PASSES = 2
"""A sample is linearised at most this often, for known conditions once: p is nearly linear over `NARROW`."""
NEAR = 0.02
"""Beliefs closer than this [share of the prior's standard deviation] are linearised at one p, and a belief that a
sample moves less than this is not linearised again."""
SCALE_MEMORY = 50
"""The scale of errors relative to training is a mean over this many samples."""
SCALE_FIRST = 5
"""The first mean of that scale is over this many samples, so that it adapts quickly."""
SETTLED = 0.3
"""p is settled when its standard deviation is below this share of the prior's in every direction."""
RECENT = 20
"""Gauss-Newton uses this many samples."""
FEW = 3
"""Gauss-Newton chooses its start among the trained p by this many of the newest samples."""
FADE = 0.9
"""Gauss-Newton weights a sample by this relative to the next one."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior distribution of p: the spread of the trained ones.

    Attributes:
        mean: Mean, shape (bias_size,).
        covariance: Covariance, shape (bias_size, bias_size).
        known: The trained p, shape (conditions, bias_size).
    """

    mean: np.ndarray
    covariance: np.ndarray
    known: np.ndarray

    @classmethod
    def of(cls, schema: BodySchema) -> "Prior":
        """Make the prior of the trained conditions; of the present p alone if there are none."""
        known = np.stack([p.astype(float) for p in schema.biases.values()] or [schema.bias.astype(float)])
        deviation = known - known.mean(axis=0)
        covariance = deviation.T @ deviation / max(1, len(known) - 1)
        floor = 0.01 * (np.trace(covariance) / max(1, len(covariance))) + 1e-4
        return cls(known.mean(axis=0), covariance + floor * np.eye(len(covariance)), known)

    def between(self, p: np.ndarray, other: np.ndarray) -> float:
        """Return the distance of two p, in standard deviations of the trained ones."""
        difference = np.asarray(p, float) - other
        return float(np.sqrt(difference @ np.linalg.solve(self.covariance, difference)))

    @property
    def gap(self) -> float:
        """Largest distance of a trained p from its nearest other one [their standard deviations]; 0 with one."""
        if len(self.known) < 2:
            return 0.0
        others = (np.delete(self.known, index, axis=0) for index in range(len(self.known)))
        pairs = zip(self.known, others, strict=True)
        return max(min(self.between(p, other) for other in rest) for p, rest in pairs)

    def beyond(self, p: np.ndarray) -> float:
        """Return how much further p is from all trained ones than these are from each other; 0 if it is not."""
        if len(self.known) < 2:
            return 0.0
        return max(0.0, min(self.between(p, known) for known in self.known) - self.gap)

    def is_beyond(self, p: np.ndarray) -> bool:
        """Whether p is further from all trained ones than these are from their nearest other ones."""
        return self.beyond(p) > 0.0

    def is_settled(self, covariance: np.ndarray) -> bool:
        """Whether a p of this covariance, shape (bias_size, bias_size), is well known in every direction."""
        return bool(beliefs.is_below(covariance, SETTLED**2 * self.covariance))


@dataclass(frozen=True, slots=True)
class Recognition:
    """Estimate of p.

    Attributes:
        bias: p, shape (bias_size,).
        covariance: Its covariance, shape (bias_size, bias_size).
        since: Number of samples since the last change of the body.
        is_settled: Whether p is well known.
    """

    bias: np.ndarray
    covariance: np.ndarray
    since: int
    is_settled: bool


class Recogniser(Protocol):
    """An estimator of p from samples, one at a time."""

    def see(self, schema: BodySchema, row: np.ndarray) -> Recognition:
        """Take one sample [standard deviations], shape (size,), predicted by the W of a schema."""
        ...


class Kalman:
    """A bank of beliefs about p, weighted by their predictions of new samples.

    First come the trained conditions, whose p is constant; then filters of an unknown condition, one per sample at
    which the body may have changed.
    """

    def __init__(self, schema: BodySchema) -> None:
        self.prior = Prior.of(schema)
        self._innovations = Innovations(schema)
        self._known = known = len(schema.biases)
        mean = self.prior.known[:known]
        share = np.full(known, (1.0 - TRUST) / max(1, known))
        distances = [self.prior.between(schema.bias, p) for p in mean]
        if known and min(distances) < NARROW:
            share[int(np.argmin(distances))] += TRUST
        else:
            mean = np.concatenate([mean, schema.bias.astype(float)[None]])
            share = np.append(share, TRUST)
        self._count, room, size = len(share), known + BANK + 1, len(schema.bias)
        self._beliefs = beliefs.Beliefs(
            np.zeros((room, size)), np.zeros((room, size, size)), np.zeros(room), np.zeros(room)
        )
        self._beliefs.mean[: len(share)] = mean
        self._beliefs.covariance[: len(share)] = NARROW**2 * self.prior.covariance
        self._beliefs.weight[: len(share)] = np.log(share)
        self._near = NEAR * np.sqrt(np.diag(self.prior.covariance))
        self._rules = beliefs.Rules(known, PASSES, HAZARD, FAMILIAR, DRIFT**2, FREEDOM, FAINTEST)
        self._scale = 1.0
        self._seen = 0

    def see(self, schema: BodySchema, row: np.ndarray) -> Recognition:
        """Weight all beliefs by a sample, and move those of no known condition."""
        pairs = self._innovations.pairs(np.isfinite(row))
        if len(pairs.index):
            prior, shape = self.prior, pairs.parts
            seen, self._count = bank.see(
                schema.predictor, row, self._beliefs, self._count, (prior.mean, prior.covariance), shape,
                pairs.log_volume, self._near, self._scale, self._rules,
            )  # fmt: skip
            self._seen += 1
            self._scale = max(1.0, self._scale * (1.0 + (seen - 1.0) / min(SCALE_FIRST + self._seen, SCALE_MEMORY)))
        mean, covariance, age = beliefs.summary(self._beliefs, self._count)
        return Recognition(mean, covariance, round(age), self.prior.is_settled(covariance))


class GaussNewton:
    """An estimator by the p that explains the newest samples best."""

    def __init__(self, schema: BodySchema) -> None:
        self.prior = Prior.of(schema)
        self._innovations = Innovations(schema)
        self._rows: list[np.ndarray] = []
        self._bias = schema.bias.astype(float)

    def see(self, schema: BodySchema, row: np.ndarray) -> Recognition:
        """Take a sample and solve for p."""
        self._rows = [row, *self._rows[: RECENT - 1]]
        self._bias, covariance = solve(schema, self._innovations, self.prior, np.stack(self._rows), self._bias, FADE)
        return Recognition(self._bias.copy(), covariance, len(self._rows), self.prior.is_settled(covariance))


def solve(
    schema: BodySchema,
    innovations: Innovations,
    prior: Prior,
    rows: np.ndarray,
    start: np.ndarray,
    fade: float = 1.0,
    iterations: int = 6,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve for the p of least squares of whitened errors and of the distance from the prior, by damped Gauss-Newton.

    Args:
        schema: The schema whose W predicts.
        innovations: The errors and their covariance.
        prior: The prior of p.
        rows: Samples [standard deviations], newest first, shape (n, size).
        start: First p, shape (bias_size,); the trained ones are tried too.
        fade: Weight of a sample relative to the next one.
        iterations: Maximum number of steps.

    Returns:
        p and its covariance.
    """
    finite = np.isfinite(rows)
    patterns = [np.flatnonzero((finite == pattern).all(axis=1)) for pattern in np.unique(finite, axis=0)]
    groups = [(innovations.pairs(finite[index[0]]), index) for index in patterns]
    precision = np.linalg.inv(prior.covariance)

    def fit(bias: np.ndarray, newest: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Return cost, gradient and curvature over the newest samples."""
        distance = bias - prior.mean
        cost, gradient, curvature = float(distance @ precision @ distance), precision @ distance, precision.copy()
        for pairs, members in groups:
            index = members[members < newest]
            if len(pairs.index) and len(index):
                biases = np.repeat(bias[None], len(index), axis=0).astype(np.float32)
                error, slope = innovations.of(schema, pairs, rows[index], biases)
                weight = fade**index
                cost += float(weight @ np.einsum("ij,ij->i", error, error))
                gradient = gradient - np.einsum("i,ijk,ij->k", weight, slope, error)
                curvature += np.einsum("i,ijk,ijl->kl", weight, slope, slope)
        return cost, gradient, curvature

    best = min((start, *prior.known), key=lambda bias: fit(bias, FEW)[0])
    cost, gradient, curvature = fit(best, len(rows))
    damping = 0.0
    for _ in range(iterations):
        step = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), -gradient)
        tried = fit(best + step, len(rows))
        if tried[0] < cost:
            is_done = cost - tried[0] < 1e-3
            best, (cost, gradient, curvature), damping = best + step, tried, 0.3 * damping
            if is_done:
                break
        else:
            damping = max(0.1, 4.0 * damping)
    return best, np.linalg.inv(curvature)


def recognise(schema: BodySchema, rows: np.ndarray, method: str) -> np.ndarray:
    """Return the p recognised from samples [standard deviations], oldest first, shape (n, size)."""
    recogniser, bias = RECOGNISERS[method](schema), schema.bias
    for row in rows.astype(float):
        bias = recogniser.see(schema.with_bias(bias), row).bias
    return bias


RECOGNISERS: dict[str, Callable[[BodySchema], Recogniser]] = {"ekf": Kalman, "gauss_newton": GaussNewton}
