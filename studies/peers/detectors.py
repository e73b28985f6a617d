"""Ordinary detectors of anomalies: each learns from healthy rows and returns a score per row, high for unusual ones.

Inputs are in standard deviations of the training rows. The two residuals predict every signal from all others, and
their normal errors are those of blocks of time that the regression did not learn from.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from sklearn.covariance import LedoitWolf
from sklearn.ensemble import HistGradientBoostingRegressor, IsolationForest
from sklearn.neighbors import LocalOutlierFactor, NearestNeighbors

from studies.peers.estimators import ALPHAS, scales, solve

VERSION = 1
"""Number of this version of the detectors; results of another version are not taken from the cache."""
NEIGHBOURS = 20
ROWS = 6000
"""Largest number of rows that a detector keeps."""
FOLDS, TREES, BOOST_ROWS = 3, 100, 3000


@dataclass(frozen=True, slots=True)
class Healthy:
    """Healthy rows, and rows to be scored.

    Attributes:
        rows: Healthy rows, shape (n, size).
        signal: Index of the signal of every column, shape (size,).
        query: Rows to be scored, shape (m, size).
        seed: Seed of the method's chance.
    """

    rows: np.ndarray
    signal: np.ndarray
    query: np.ndarray
    seed: int


def outlier_factor(data: Healthy) -> np.ndarray:
    """Return the local outlier factor."""
    model = LocalOutlierFactor(n_neighbors=NEIGHBOURS, novelty=True).fit(data.rows)
    return np.asarray(-model.score_samples(data.query))


def neighbour_distance(data: Healthy) -> np.ndarray:
    """Return the mean distance to the nearest healthy rows."""
    model = NearestNeighbors(n_neighbors=NEIGHBOURS).fit(data.rows)
    return np.asarray(model.kneighbors(data.query)[0].mean(axis=1))


def isolation_forest(data: Healthy) -> np.ndarray:
    """Return the score of an isolation forest."""
    model = IsolationForest(n_estimators=300, max_samples=256, random_state=data.seed).fit(data.rows)
    return np.asarray(-model.score_samples(data.query))


Fit = Callable[[np.ndarray, np.ndarray], Callable[[np.ndarray], np.ndarray]]
"""A regression learns from x, shape (n, d), and y, shape (n, k), and returns its prediction as a function."""


def residual(data: Healthy, fit: Fit) -> np.ndarray:
    """Return the Mahalanobis distance of every signal minus its prediction from all others."""
    blocks = np.arange(len(data.rows)) * 10 * FOLDS // len(data.rows)
    errors, asked = np.empty_like(data.rows), np.empty_like(data.query)
    for index in np.unique(data.signal):
        mine, rest = data.signal == index, data.signal != index
        for fold in range(FOLDS):
            held = blocks % FOLDS == fold
            predict = fit(data.rows[~held][:, rest], data.rows[~held][:, mine])
            errors[np.ix_(held, mine)] = data.rows[np.ix_(held, mine)] - predict(data.rows[held][:, rest])
        asked[:, mine] = data.query[:, mine] - fit(data.rows[:, rest], data.rows[:, mine])(data.query[:, rest])
    return np.asarray(np.sqrt(LedoitWolf().fit(errors).mahalanobis(asked)))


def linear(x: np.ndarray, y: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Fit ridge regression; its weight is chosen by two of ten blocks of time."""
    held = np.isin(np.arange(len(x)) * 10 // len(x), (3, 8))
    tried = solve(x[~held], y[~held], ALPHAS)
    misses = [np.mean((x[held] @ weights + offset - y[held]) ** 2) for weights, offset in tried]
    ((weights, offset),) = solve(x, y, ALPHAS[[int(np.argmin(misses))]])
    return lambda query: query @ weights + offset


def boosted(seed: int) -> Fit:
    """Return histogram gradient boosting, one model per element."""

    def fit(x: np.ndarray, y: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        models = [
            HistGradientBoostingRegressor(max_iter=TREES, early_stopping=False, random_state=seed).fit(x, column)
            for column in y.T
        ]
        return lambda query: np.column_stack([model.predict(query) for model in models])

    return fit


def thinned(data: Healthy, count: int) -> Healthy:
    """Return the data with at most this number of healthy rows, evenly spaced."""
    every = max(1, -(-len(data.rows) // count))
    return Healthy(data.rows[::every], data.signal, data.query, data.seed)


DETECTORS: dict[str, Callable[[Healthy], np.ndarray]] = {
    "outlier_factor": outlier_factor,
    "neighbour_distance": neighbour_distance,
    "isolation_forest": isolation_forest,
    "ridge_residual": lambda data: residual(data, linear),
    "boosted_residual": lambda data: residual(thinned(data, BOOST_ROWS), boosted(data.seed)),
}


def detect(name: str, rows: np.ndarray, signal: np.ndarray, query: np.ndarray, seed: int, version: int) -> np.ndarray:
    """Return the scores of a detector, shape (m,); the arguments are the key of the cache.

    Args:
        name: Key of `DETECTORS`.
        rows: Healthy rows [unit of each signal], shape (n, size).
        signal: Index of the signal of every column, shape (size,).
        query: Rows to be scored [unit of each signal], shape (m, size).
        seed: Seed of the method's chance.
        version: Number of the version of the detectors.
    """
    mean, std = scales(rows)
    moves = rows.std(axis=0) > 0.0
    x, asked = ((rows - mean) / std)[:, moves], ((query - mean) / std)[:, moves]
    return DETECTORS[name](thinned(Healthy(x, signal[moves], asked, seed), ROWS))
