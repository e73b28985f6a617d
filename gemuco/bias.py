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
from typing import TYPE_CHECKING, Protocol

import numpy as np

from gemuco.compiled import bank
from gemuco.innovation import Innovations

if TYPE_CHECKING:
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
"""How often a sample is linearised."""
NEAR = 0.02
"""A belief that the sample moves less than this share of the prior's standard deviation is not linearised again."""
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
    def of(cls, schema: "BodySchema") -> "Prior":
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

    def share(self, covariance: np.ndarray) -> float:
        """Largest standard deviation of a p over all directions, as a share of the prior's."""
        whiten = np.linalg.inv(np.linalg.cholesky(self.covariance))
        return float(np.sqrt(np.linalg.eigvalsh(whiten @ covariance @ whiten.T)[-1]))


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

    def see(self, schema: "BodySchema", row: np.ndarray) -> Recognition:
        """Take one sample [standard deviations], shape (size,), predicted by the W of a schema."""
        ...


class Kalman:
    """A bank of beliefs about p, weighed by how well each foretells what comes.

    First the trained conditions, whose p stays; then filters that know no condition, one per moment at which the body
    may have become a new one.
    """

    def __init__(self, schema: "BodySchema") -> None:
        self.prior = Prior.of(schema)
        self._innovations = Innovations(schema)
        self._known = known = len(schema.biases)
        self._mean = self.prior.known[:known]
        share = np.full(known, (1.0 - TRUST) / max(1, known))
        away = [self.prior.between(schema.bias, p) for p in self._mean]
        if known and min(away) < NARROW:
            share[int(np.argmin(away))] += TRUST
        else:
            self._mean = np.concatenate([self._mean, schema.bias.astype(float)[None]])
            share = np.append(share, TRUST)
        self._covariance = np.repeat(NARROW**2 * self.prior.covariance[None], len(share), axis=0)
        self._weight = np.log(share)
        self._age = np.zeros(len(share))
        self._near = NEAR * np.sqrt(np.diag(self.prior.covariance))
        self._scale = 1.0
        self._seen = 0

    def see(self, schema: "BodySchema", row: np.ndarray) -> Recognition:
        """Weigh all beliefs by a sample, and move those that are not of a known condition."""
        pairs = self._innovations.pairs(np.isfinite(row))
        if len(pairs.index):
            self._begin_anew()
            numbers = (self._known, PASSES, self._scale, FREEDOM, pairs.log_volume, FAINTEST)
            shape = (pairs.through, pairs.tails, pairs.index, pairs.whiten)
            beliefs = (self._mean, self._covariance, self._weight)
            seen = bank.see(schema.ready.predictor, row, *beliefs, shape, self._near, numbers)
            self._seen += 1
            self._scale = max(1.0, self._scale * (1.0 + (seen - 1.0) / min(SCALE_FIRST + self._seen, SCALE_MEMORY)))
            self._thin()
        return self._found()

    def _found(self) -> Recognition:
        """The mean over all beliefs; its covariance contains how far they are apart."""
        share = np.exp(self._weight)
        share /= share.sum()
        mean = share @ self._mean
        away = self._mean - mean
        covariance = np.einsum("h,hjk->jk", share, self._covariance) + np.einsum("h,hj,hk->jk", share, away, away)
        since = round(float(self._age[int(np.argmax(self._weight))]))
        return Recognition(mean, covariance, since, self.prior.share(covariance) < SETTLED)

    def _begin_anew(self) -> None:
        """The body may have changed just now, to a known condition or to a new one; everybody else is less sure."""
        prior, known = self.prior, self._known
        total = float(np.exp(self._weight).sum())
        stays = np.exp(self._weight) * (1.0 - HAZARD)
        comes = np.zeros(len(stays))
        if known:
            comes[:known] = HAZARD * FAMILIAR * total / known
        unknown = HAZARD * (1.0 - FAMILIAR if known else 1.0) * total
        self._age = np.append((stays * (self._age + 1) + comes) / (stays + comes), 1.0)
        self._weight = np.log(np.append(stays + comes, unknown))
        self._covariance[known:] += DRIFT**2 * prior.covariance
        self._mean = np.concatenate([self._mean, prior.mean[None]])
        self._covariance = np.concatenate([self._covariance, prior.covariance[None]])

    def _thin(self) -> None:
        """Too many filters: of the two whose ages differ least in proportion, the less likely goes."""
        while len(self._weight) > self._known + BANK:
            order = self._known + np.argsort(self._age[self._known :])
            ratio = self._age[order][1:] / self._age[order][:-1]
            closest = int(np.argmin(ratio))
            one, other = order[closest], order[closest + 1]
            gone = one if self._weight[one] < self._weight[other] else other
            for name in ("_mean", "_covariance", "_weight", "_age"):
                setattr(self, name, np.delete(getattr(self, name), gone, axis=0))


class GaussNewton:
    """The p that explains the newest samples best."""

    def __init__(self, schema: "BodySchema") -> None:
        self.prior = Prior.of(schema)
        self._innovations = Innovations(schema)
        self._rows: list[np.ndarray] = []
        self._bias = schema.bias.astype(float)

    def see(self, schema: "BodySchema", row: np.ndarray) -> Recognition:
        """Take a sample and find p anew."""
        self._rows = [row, *self._rows[: RECENT - 1]]
        self._bias, covariance = solve(schema, self._innovations, self.prior, np.stack(self._rows), self._bias, FADE)
        settled = self.prior.share(covariance) < SETTLED
        return Recognition(self._bias.copy(), covariance, len(self._rows), settled)


def solve(
    schema: "BodySchema",
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


RECOGNISERS: dict[str, Callable[["BodySchema"], Recogniser]] = {"ekf": Kalman, "gauss_newton": GaussNewton}
