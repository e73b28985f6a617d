"""Recognition of p from samples (paper, usage (d), done with second-order information instead of gradient steps).

`Kalman` is a bank of extended Kalman filters that differ in when they believe the body last changed (Bayesian change
point detection): at every sample a new one begins from the spread of the trained p, and each is weighed by how well it
foretold what came since. A tool that was put down is recognised as soon as the evidence of the newcomers outweighs the
old belief, at once where one sample says enough, after many where each says little; without a change nothing is
forgotten. The errors are taken as t-distributed, so one odd sample moves nothing.

`GaussNewton` minimises the errors over the newest samples of a window from the same prior. It has no memory but that.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gemuco.adaption.innovation import Innovations
from gemuco.compiled import bank, beliefs
from gemuco.schema import BodySchema

HAZARD = 0.01
"""How often the body changes, per sample."""
BANK = 8
"""Filters kept."""
DRIFT = 0.01
"""Share of the prior's standard deviation by which p may wander per sample."""
TRUST = 0.5
"""How likely the p in use when recognition begins is right."""
FREEDOM = 8.0
"""Degrees of freedom of the errors' t-distribution."""
NARROW = 0.05
"""Standard deviation of p within a known condition, as a share of the prior's."""
FAMILIAR = 0.9
"""How often the body that comes is one of the known conditions."""
FAINTEST = -60.0
"""Logarithm of the smallest weight against the largest, so that no condition becomes impossible."""
PASSES = 2
"""How often a sample is linearised at most; for known conditions once, a straight line is enough over `NARROW`."""
NEAR = 0.02
"""Beliefs this near to each other [share of the prior's standard deviation] are linearised at one p, and one that the
sample moves less than this is not linearised again."""
SCALE_MEMORY = 50
"""Samples over which it is learned that errors are larger here than in training; at first fewer, to be there soon."""
SCALE_FIRST = 5
SETTLED = 0.3
"""p is settled when its standard deviation is below this share of the prior's in every direction."""
RECENT = 20
"""Samples that Gauss-Newton looks at."""
FEW = 3
"""Newest samples by which Gauss-Newton chooses among the trained p where to begin."""
FADE = 0.9
"""Weight of a sample against the one after it, for Gauss-Newton."""


@dataclass(frozen=True, slots=True)
class Prior:
    """What p can be: the spread of the trained ones.

    Attributes:
        mean: Shape (bias_size,).
        covariance: Shape (bias_size, bias_size).
        known: The trained p, shape (conditions, bias_size).
    """

    mean: np.ndarray
    covariance: np.ndarray
    known: np.ndarray

    @classmethod
    def of(cls, schema: BodySchema) -> "Prior":
        """From the p of the trained conditions; from the present one alone if there are none."""
        known = np.stack([p.astype(float) for p in schema.biases.values()] or [schema.bias.astype(float)])
        away = known - known.mean(axis=0)
        covariance = away.T @ away / max(1, len(known) - 1)
        floor = 0.01 * (np.trace(covariance) / max(1, len(covariance))) + 1e-4
        return cls(known.mean(axis=0), covariance + floor * np.eye(len(covariance)), known)

    def between(self, one: np.ndarray, other: np.ndarray) -> float:
        """Distance of two p, in standard deviations of the trained ones."""
        away = np.asarray(one, float) - other
        return float(np.sqrt(away @ np.linalg.solve(self.covariance, away)))

    def is_settled(self, covariance: np.ndarray) -> bool:
        """Whether a p of this covariance, shape (bias_size, bias_size), is well known in every direction."""
        return bool(beliefs.is_below(covariance, SETTLED**2 * self.covariance))


@dataclass(frozen=True, slots=True)
class Recognition:
    """What is believed about p.

    Attributes:
        bias: p, shape (bias_size,).
        covariance: Its uncertainty, shape (bias_size, bias_size).
        since: Samples since which this is believed to be the body.
        is_settled: Whether p is well known.
    """

    bias: np.ndarray
    covariance: np.ndarray
    since: int
    is_settled: bool


class Recogniser(Protocol):
    """Finds p from samples, one at a time."""

    def see(self, schema: BodySchema, row: np.ndarray) -> Recognition:
        """Take one sample [standard deviations], shape (size,), predicted by the W of a schema."""
        ...


class Kalman:
    """A bank of beliefs about p, weighed by how well each foretells what comes.

    First the trained conditions, whose p stays; then filters that know no condition, one per moment at which the body
    may have become a new one.
    """

    def __init__(self, schema: BodySchema) -> None:
        self.prior = Prior.of(schema)
        self._innovations = Innovations(schema)
        self._known = known = len(schema.biases)
        mean = self.prior.known[:known]
        share = np.full(known, (1.0 - TRUST) / max(1, known))
        away = [self.prior.between(schema.bias, p) for p in mean]
        if known and min(away) < NARROW:
            share[int(np.argmin(away))] += TRUST
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
        """Weigh all beliefs by a sample, and move those that are not of a known condition."""
        pairs = self._innovations.pairs(np.isfinite(row))
        if len(pairs.index):
            prior, shape = self.prior, (pairs.through, pairs.tails, pairs.index, pairs.whiten)
            seen, self._count = bank.see(
                schema.predictor, row, self._beliefs, self._count, (prior.mean, prior.covariance), shape,
                pairs.log_volume, self._near, self._scale, self._rules,
            )  # fmt: skip
            self._seen += 1
            self._scale = max(1.0, self._scale * (1.0 + (seen - 1.0) / min(SCALE_FIRST + self._seen, SCALE_MEMORY)))
        mean, covariance, age = beliefs.summary(self._beliefs, self._count)
        return Recognition(mean, covariance, round(age), self.prior.is_settled(covariance))


class GaussNewton:
    """The p that explains the newest samples best."""

    def __init__(self, schema: BodySchema) -> None:
        self.prior = Prior.of(schema)
        self._innovations = Innovations(schema)
        self._rows: list[np.ndarray] = []
        self._bias = schema.bias.astype(float)

    def see(self, schema: BodySchema, row: np.ndarray) -> Recognition:
        """Take a sample and find p anew."""
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
    """Gauss-Newton with damping: the p of the least squares of whitened errors and of the distance from the prior.

    Args:
        schema: Whose W predicts.
        innovations: The errors and their covariance.
        prior: What p can be.
        rows: Samples [standard deviations], newest first, shape (n, size).
        start: First p, shape (bias_size,); the trained ones are tried as well.
        fade: Weight of a sample against the one after it.
        iterations: At most so many steps.

    Returns:
        p and its covariance.
    """
    finite = np.isfinite(rows)
    patterns = [np.flatnonzero((finite == pattern).all(axis=1)) for pattern in np.unique(finite, axis=0)]
    groups = [(innovations.pairs(finite[index[0]]), index) for index in patterns]
    precision = np.linalg.inv(prior.covariance)

    def fit(bias: np.ndarray, newest: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost, gradient and curvature over the newest samples."""
        away = bias - prior.mean
        cost, gradient, curvature = float(away @ precision @ away), precision @ away, precision.copy()
        for pairs, everything in groups:
            index = everything[everything < newest]
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


RECOGNISERS: dict[str, Callable[[BodySchema], Recogniser]] = {"ekf": Kalman, "gauss_newton": GaussNewton}
