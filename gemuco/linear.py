"""Linear path of the network: what is linear in a body is learned as linear, in closed form.

Ridge regression predicts the main components of x_out, the code l, from the signals of a mask. The network receives l
as a further input, carries it past its activations to z and to the output, and learns the rest. So a linear body is as
exact as ridge regression, and outside of the training data the estimate goes on along the line.

The second moments of the training data are kept instead of one matrix per mask: they determine the regression of every
mask.
"""

from dataclasses import dataclass

import numpy as np

RIDGES = tuple(10.0**power for power in range(-9, 1))
"""Candidate strengths of the regularisation, as shares of an element's variance."""
FOLDS = 5
"""The strength is chosen on this many contiguous parts of the data, each predicted from the others."""
MOST_MASKS = 16
"""At most this many masks decide about the strength."""
ROBUST = 3.0
"""The weight of a row falls when its error is above this many robust standard deviations."""
PASSES = 3
"""Number of regressions, each with the weights that follow from the errors of the one before."""


@dataclass(frozen=True, slots=True)
class LinearPath:
    """Ridge regression of the code l from the elements of x_in, under any mask.

    Attributes:
        moments: Mean of the products of x_in and 1 [standard deviations squared], shape (in_size + 1, in_size + 1).
        cross: Mean of the products of x_in and 1 with the code, shape (in_size + 1, width).
        ridge: Strength of the regularisation.
    """

    moments: np.ndarray
    cross: np.ndarray
    ridge: float

    @classmethod
    def none(cls, in_size: int) -> "LinearPath":
        """Return a path without code, as in a network without linear path."""
        return cls(np.zeros((in_size + 1, in_size + 1)), np.zeros((in_size + 1, 0)), 1.0)

    @classmethod
    def fit(cls, x: np.ndarray, code: np.ndarray, gates: np.ndarray) -> "LinearPath":
        """Learn from samples, oldest first.

        Args:
            x: x_in [standard deviations], shape (samples, in_size), complete.
            code: The code of each sample, shape (samples, width).
            gates: 1 for the elements of x_in that each mask contains, else 0, shape (masks, in_size).
        """
        rows = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        gates = gates[np.linspace(0, len(gates) - 1, min(MOST_MASKS, len(gates))).astype(int)]
        widest = gates[gates.sum(axis=1).argmax()]
        weight = np.ones(len(rows))
        for _ in range(PASSES):
            path = cls._of(rows, code, weight, gates)
            error = np.linalg.norm(code - rows @ path.map(widest), axis=1)
            limit = ROBUST * np.median(error)
            weight = np.minimum(1.0, limit / np.maximum(error, 1e-12)) if limit > 0.0 else np.ones(len(rows))
        return path

    @classmethod
    def _of(cls, rows: np.ndarray, code: np.ndarray, weight: np.ndarray, gates: np.ndarray) -> "LinearPath":
        weighted, parts = rows * weight[:, None], np.array_split(np.arange(len(rows)), FOLDS)
        moments = [weighted[part].T @ rows[part] for part in parts]
        cross = [weighted[part].T @ code[part] for part in parts]
        whole, total, count = np.sum(moments, axis=0), np.sum(cross, axis=0), weight.sum()
        losses = np.zeros(len(RIDGES))
        for index, ridge in enumerate(RIDGES):
            for part, product in zip(moments, cross, strict=True):
                rest = cls((whole - part) / count, (total - product) / count, ridge)
                for gate in gates:
                    line = rest.map(gate)
                    losses[index] += np.sum(line * (part @ line)) - 2.0 * np.sum(line * product)
        return cls(whole / count, total / count, RIDGES[int(losses.argmin())])

    @property
    def width(self) -> int:
        """Length of the code."""
        return self.cross.shape[1]

    def map(self, gate: np.ndarray) -> np.ndarray:
        """Return the regression under a mask: l = (x_in, 1) map, shape (in_size + 1, width), float32.

        Args:
            gate: 1 for the elements of x_in that the mask contains, else 0, shape (in_size,).
        """
        result = np.zeros(self.cross.shape, np.float32)
        known = np.append(np.flatnonzero(gate), len(gate))
        if self.width:
            system = self.moments[np.ix_(known, known)].copy()
            system[np.diag_indices(len(known) - 1)] += self.ridge * np.diag(system)[:-1] + 1e-10
            system[-1, -1] += 1e-12
            result[known] = np.linalg.solve(system, self.cross[known])
        return result


def basis(x_out: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of x_out, shape (out_size,), and its main components, shape (width, out_size), orthonormal.

    Args:
        x_out: Complete samples [standard deviations], shape (samples, out_size).
        width: Number of components; with one per element they are the elements themselves.
    """
    mean = x_out.mean(axis=0)
    if width >= x_out.shape[1]:
        return mean, np.eye(x_out.shape[1])
    _, _, components = np.linalg.svd(np.cov(x_out.T))
    return mean, components[:width]
