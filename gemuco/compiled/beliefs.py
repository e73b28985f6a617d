"""The beliefs about p, apart from samples; `gemuco.adaption.recognise.Kalman` says what they mean."""

from typing import NamedTuple

import numpy as np

from gemuco.compiled.jit import jit


class Beliefs(NamedTuple):
    """Room for as many beliefs as there may be, and one more while a sample is looked at.

    Attributes:
        mean: p of every belief, shape (room, k); the known conditions come first.
        covariance: Of every p, shape (room, k, k).
        weight: Logarithm of how likely each is, shape (room,).
        age: Samples since which each is believed, shape (room,).
    """

    mean: np.ndarray
    covariance: np.ndarray
    weight: np.ndarray
    age: np.ndarray


class Rules(NamedTuple):
    """Numbers that do not change; see the constants of `gemuco.adaption.recognise` for what they mean.

    Attributes:
        known: How many of the beliefs are known conditions.
        passes: How often a sample is linearised at most.
        hazard: How often the body changes, per sample.
        familiar: How often it then is a known condition.
        drift: Variance of p's wandering per sample, as a share of the prior's.
        freedom: Of the errors' t-distribution.
        faintest: Logarithm of the smallest weight against the largest.
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
    """The sum one + share * other into `out`, shapes (k, k)."""
    for i in range(len(one)):
        for j in range(len(one)):
            out[i, j] = one[i, j] + share * other[i, j]


@jit
def begin_anew(beliefs, count, mean, covariance, rules):
    """The body may have changed just now, to a known condition or to a new one; everybody else is less sure.

    Args:
        beliefs: Are changed in place; the new one comes behind the last.
        count: How many there are.
        mean: Of the prior, shape (k,).
        covariance: Of the prior, shape (k, k).
        rules: Numbers.
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
    """Too many filters: of two whose ages differ least in proportion the less likely goes; returns how many stay."""
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
    """The mean over all beliefs, shape (k,), its covariance, which contains how far they are apart, and the age."""
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
    """Whether a covariance is smaller than another one in every direction, shapes (k, k).

    Then their difference is positive definite, and Cholesky's method finds no number that has no root.
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
