"""An order of rows in which the first few tell the mean of all as well as they can.

Some errors of every row are known beforehand, those under a few other masks. What is bad under these is likely to be
bad again, and means of skewed errors are made by such rows. So rows are drawn by priority sampling (N. Duffield,
C. Lund, M. Thorup, 2007), the bad ones first and with less weight; and the weights are then changed until the first
rows tell the known means of all rows exactly (calibration; J.-C. Deville, C.-E. Särndal, 1992).
"""

from dataclasses import dataclass

import numpy as np

MOST_KNOWN = 6
"""So many directions of known errors at most have their means told exactly: each takes something of what few rows tell
of everything else."""
FLOOR = 0.5
"""What is added to the known error of a row, in mean known errors: known to be good is no promise."""


@dataclass(frozen=True, slots=True)
class Heat:
    """The first rows of an order, and how much each of them tells of all.

    What is to be told is the mean of a value over all rows. For values v of the first rows that is `weights` @ v; its
    variance is told by what known errors do not explain of v, d = v - known @ (v @ project), as `doubt` @ d^2.

    Attributes:
        weights: Of sum 1, shape (rows,).
        known: Known errors, shape (rows, k).
        project: Shape (rows, k).
        doubt: Shape (rows,).
        hidden: So much would one unseen row add to the mean that is as bad, beside its known error, as this row is
            beside its own: to be multiplied by its value, shape (rows,).
    """

    weights: np.ndarray
    known: np.ndarray
    project: np.ndarray
    doubt: np.ndarray
    hidden: np.ndarray

    def __len__(self) -> int:
        return len(self.weights)


class RowDraw:
    """Rows in the order in which they are drawn.

    Args:
        known: Known errors of all rows, shape (n, rows), at least 0.
        seed: Of the draw.

    Attributes:
        order: Indices of the rows, shape (rows,).
    """

    def __init__(self, known: np.ndarray, seed: int) -> None:
        size = known.mean(axis=0, dtype=float)
        size = size + FLOOR * size.mean() if size.any() else np.ones(len(size))
        priority = size / (1.0 - np.random.default_rng(seed).random(len(size)))
        self.order = np.argsort(-priority)
        self._size, self._priority = size[self.order], priority[self.order]
        known = known[:, self.order].astype(float)
        _, spread, directions = np.linalg.svd(known - known.mean(axis=1, keepdims=True), full_matrices=False)
        kept = directions[:MOST_KNOWN][spread[:MOST_KNOWN] > 1e-6 * spread.max(initial=0.0)]
        self._known = np.concatenate([np.ones((1, len(size))), kept * np.sqrt(len(size))]).T

    def heat(self, rows: int) -> Heat:
        """The first so many, fewer than all."""
        size, known, total = self._size[:rows], self._known[:rows], len(self.order)
        left = self._priority[rows]  # the highest that was not drawn
        drawn = np.maximum(1.0, left / size)  # rows of all that each of these stands for
        project = (known * drawn[:, None]) @ np.linalg.pinv((known.T * drawn) @ known)
        weights = project @ self._known.mean(axis=0)
        # What is left over is smaller than it was by as many directions as were fitted, and is known from fewer rows.
        fitted = rows / (rows - known.shape[1])
        doubt = (weights * fitted) ** 2 * (1.0 - 1.0 / drawn)
        hidden = left / size / total
        return Heat(*(np.ascontiguousarray(part) for part in (weights, known, project, doubt, hidden)))
