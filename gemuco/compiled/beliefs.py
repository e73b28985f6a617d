"""Beliefs about p, and their operations without samples; `gemuco.adaption.recognise.Kalman` explains the method."""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.jit import jit


class Beliefs(NamedTuple):
    """Memory for the largest number of beliefs, and for one more during a sample.

    Attributes:
        mean: p of every belief, shape (room, k); the known conditions come first.
        covariance: Covariance of every p, shape (room, k, k).
        weight: Log likelihood of every belief, shape (room,).
        age: Number of samples since the body change that each belief assumes, shape (room,).
    """

    mean: np.ndarray
    covariance: np.ndarray
    weight: np.ndarray
    age: np.ndarray


class Rules(NamedTuple):
    """Constants; those of `gemuco.adaption.recognise` explain them.

    Attributes:
        known: Number of beliefs that are known conditions.
        passes: Largest number of linearisations per sample.
        hazard: Probability of a body change per sample.
        familiar: Probability that a changed body is a known condition.
        drift: Variance of the drift of p per sample, as a share of the prior's variance.
        freedom: Degrees of freedom of the errors' t-distribution.
        faintest: Logarithm of the smallest weight relative to the largest.
    """

    known: int
    passes: int
    hazard: float
    familiar: float
    drift: float
    freedom: float
    faintest: float


@jit
def add(one, other, share, out):
    """Write one + share * other into `out`, shapes (k, k)."""
    for i in range(len(one)):
        for j in range(len(one)):
            out[i, j] = one[i, j] + share * other[i, j]


@jit
def begin_anew(beliefs, count, mean, covariance, rules):
    """Account for a body change at this sample: add a new belief, and lower the certainty of the others.

    Args:
        beliefs: The beliefs; they are changed in place, and the new one follows the last.
        count: Number of beliefs.
        mean: Mean of the prior, shape (k,).
        covariance: Covariance of the prior, shape (k, k).
        rules: Constants.
    """
    total = 0.0
    for h in range(count):
        total += np.exp(beliefs.weight[h])
    for h in range(count):
        stays = np.exp(beliefs.weight[h]) * (1.0 - rules.hazard)
        comes = rules.hazard * rules.familiar * total / rules.known if h < rules.known else 0.0
        beliefs.age[h] = (stays * (beliefs.age[h] + 1.0) + comes) / (stays + comes)
        beliefs.weight[h] = np.log(stays + comes)
        if h >= rules.known:
            add(beliefs.covariance[h], covariance, rules.drift, beliefs.covariance[h])
    unknown = rules.hazard * (1.0 - rules.familiar if rules.known else 1.0)
    beliefs.age[count], beliefs.weight[count] = 1.0, np.log(unknown * total)
    beliefs.mean[count], beliefs.covariance[count] = mean, covariance


@jit
def thin(beliefs, count, most, known):
    """Remove beliefs until `most` remain: of the two with the most similar ages, the less likely. Return the count."""
    while count > most:
        order = np.arange(known, count)
        for i in range(1, len(order)):
            j = i
            while j and beliefs.age[order[j - 1]] > beliefs.age[order[j]]:
                order[j - 1], order[j] = order[j], order[j - 1]
                j -= 1
        closest, least = 0, np.inf
        for i in range(len(order) - 1):
            ratio = beliefs.age[order[i + 1]] / beliefs.age[order[i]]
            if ratio < least:
                closest, least = i, ratio
        one, other = order[closest], order[closest + 1]
        gone = one if beliefs.weight[one] < beliefs.weight[other] else other
        count -= 1
        for h in range(gone, count):
            beliefs.mean[h], beliefs.covariance[h] = beliefs.mean[h + 1], beliefs.covariance[h + 1]
            beliefs.weight[h], beliefs.age[h] = beliefs.weight[h + 1], beliefs.age[h + 1]
    return count


@jit
def summary(beliefs, count):
    """Return mean, shape (k,), and covariance, shape (k, k), over all beliefs, and the age of the likeliest belief."""
    size = beliefs.mean.shape[1]
    mean, covariance, away = np.zeros(size), np.zeros((size, size)), np.empty(size)
    total, likeliest = 0.0, 0
    for h in range(count):
        total += np.exp(beliefs.weight[h])
        if beliefs.weight[h] > beliefs.weight[likeliest]:
            likeliest = h
    for h in range(count):
        share = np.exp(beliefs.weight[h]) / total
        for j in range(size):
            mean[j] += share * beliefs.mean[h, j]
    for h in range(count):
        share = np.exp(beliefs.weight[h]) / total
        for j in range(size):
            away[j] = beliefs.mean[h, j] - mean[j]
        for j in range(size):
            for k in range(size):
                covariance[j, k] += share * (beliefs.covariance[h, j, k] + away[j] * away[k])
    return mean, covariance, beliefs.age[likeliest]


@jit
def is_below(covariance, limit):
    """Return whether a covariance is smaller than another one in every direction, shapes (k, k).

    This is so if their difference is positive definite, which a Cholesky decomposition shows.
    """
    size = len(covariance)
    lower = np.empty((size, size))
    for i in range(size):
        for j in range(i + 1):
            total = limit[i, j] - covariance[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    return True
