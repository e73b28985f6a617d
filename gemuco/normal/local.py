"""Size of a healthy error at each sample: a steering angle is not known from the motion of a car that stands.

The logarithm of the squared errors is regressed on the values and their squares, without the value itself and without
hidden ones, so that no lie excuses itself. A column keeps one size where held-out errors are not described better.
"""

from dataclasses import dataclass

import numpy as np

BLOCKS = 5
"""Each of this many blocks of the samples is judged by the others."""
PENALTY = 0.05
"""Ridge penalty, as a share of the number of samples."""
BETTER = 0.05
"""The mean log likelihood of held-out errors must rise by this much per error."""
LEAST = 4
"""At least this many known errors per used column are needed."""
SMALL = 0.05
"""Squared errors below this share of the usual ones are not distinguished."""
RANGE = 0.7, 4.0
"""Errors are at least and at most this many times the usual ones."""
FAR = 3.0
"""Values are clipped here [standard deviations]."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalSize:
    """Healthy errors as a function of the sample.

    Attributes:
        weights: Basis -> logarithm of the size, shape (2 * columns, columns).
        offset: Its constant, shape (columns,).
    """

    weights: np.ndarray
    offset: np.ndarray

    @classmethod
    def fit(
        cls, values: np.ndarray, ratios: np.ndarray, hidden: frozenset[int], uneven: np.ndarray | None = None
    ) -> "LocalSize":
        """Learn the sizes of healthy errors.

        Args:
            values: Known samples [standard deviations], shape (n, columns).
            ratios: Their errors [usual errors], shape (n, columns), NaN where not known.
            hidden: Columns that are not used.
            uneven: Columns whose errors differ from sample to sample, shape (columns,); held-out errors decide if None.
        """
        columns = values.shape[1]
        weights, offset = np.zeros((2 * columns, columns)), np.zeros(columns)
        basis = _basis(values)
        for column in range(columns) if uneven is None else np.flatnonzero(uneven).tolist():
            known = np.isfinite(ratios[:, column])
            used = [c for c in range(columns) if c != column and c not in hidden]
            if known.sum() < LEAST * len(used) or not used:
                continue
            own = np.array([*used, *(columns + c for c in used)])
            x, ratio = basis[np.ix_(known, own)], ratios[known, column]
            if uneven is not None or _gain(x, ratio) > BETTER:
                weights[own, column], offset[column] = _fitted(x, ratio)
                offset[column] -= 0.5 * np.log(_usual(ratio))
        return cls(weights, offset)

    @property
    def uneven(self) -> np.ndarray:
        """Columns whose errors differ from sample to sample, truth values, shape (columns,)."""
        return np.asarray(self.weights.any(axis=0))

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the size of a healthy error at samples [usual errors], shape (n, columns) -> (n, columns)."""
        return _limited(_basis(np.nan_to_num(values)) @ self.weights + self.offset)


def _gain(x: np.ndarray, ratio: np.ndarray) -> float:
    """Return by how much local sizes raise the mean log likelihood of held-out errors."""
    part, gain = np.arange(len(ratio)) * BLOCKS // len(ratio), 0.0
    for block in range(BLOCKS):
        others = part != block
        weights, constant = _fitted(x[others], ratio[others])
        size, usual = _limited(x[~others] @ weights + constant), _usual(ratio[others])
        now = ratio[~others] ** 2
        gain += 0.5 * float(np.sum(np.log(usual) + now / usual - 2.0 * np.log(size) - now / size**2))
    return gain / len(ratio)


def _usual(ratio: np.ndarray) -> float:
    """Return the mean square of errors."""
    return max(float(np.mean(ratio**2)), 1e-12)


def _basis(values: np.ndarray) -> np.ndarray:
    x = np.clip(values, -FAR, FAR)
    return np.concatenate([x, x * x - 1.0], axis=1)


def _fitted(x: np.ndarray, ratio: np.ndarray) -> tuple[np.ndarray, float]:
    """Return weights and constant of the logarithm of the size, so that errors by size have a mean square of one."""
    target = 0.5 * np.log(ratio**2 / _usual(ratio) + SMALL)
    mean = x.mean(axis=0)
    centred = x - mean
    gram = centred.T @ centred + PENALTY * len(x) * np.eye(x.shape[1])
    weights = np.linalg.solve(gram, centred.T @ (target - target.mean()))
    size = np.exp(np.clip(x @ weights, -5.0, 5.0))
    return weights, 0.5 * float(np.log(_usual(ratio / size)))


def _limited(logarithm: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(np.exp(np.clip(logarithm, -5.0, 5.0)), *RANGE))
