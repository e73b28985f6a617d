"""Linear path of the network: what is linear in a body is learned as linear, in closed form.

Ridge regression predicts the main components of x_out, the code l, from the signals of a mask. The network receives l
as a further input, carries it past its activations to z and to the output, and learns the rest. So a linear body is as
exact as ridge regression, and outside of the training data the estimate goes on along the line.

The second moments of the training data are kept instead of one matrix per mask: they determine the regression of every
mask.
"""

from dataclasses import dataclass, field

import numpy as np

RIDGES = 10.0 ** np.arange(-9.0, 1.0)
"""Candidate strengths of the regularisation, as shares of the variance of an element."""
FOLDS = 5
"""The strength is chosen on this many contiguous parts of the data, each predicted from the others."""
CACHED = 256
"""At most this many regressions are cached."""
STILL = 1e-8
"""Nothing is predicted from an element whose variance is below this [standard deviations squared]."""
SHRINKS, TURNS = 10.0 ** np.arange(-10.0, 0.0), 12
"""Candidate strengths of a penalty that leaves few inputs, and the number of regressions in which it does so."""
UNUSED = 1e-3
"""An input is left out if its weight is below this share of the largest one [standard deviations]."""
WORSE, MORE = 3.0, 0.02
"""Fewer inputs are used unless held-out parts show larger errors: by more than the first number of standard errors of
the mean over the parts, or by more than the second share of the standard deviation, as all parts together must not."""
ROBUST = 3.0
"""The weight of a row falls when its error is above this many robust standard deviations."""
PASSES = 3
"""Number of regressions, each with the weights that follow from the errors of the one before."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearPath:
    """Ridge regression of the code l from the elements of x_in, under any mask.

    Attributes:
        moments: Sums of the products of x_in and 1 over each part of the data [standard deviations squared], shape
            (parts, in_size + 1, in_size + 1).
        cross: Sums of the products of x_in and 1 with the code, shape (parts, in_size + 1, width).
        outputs: x_out by the code and 1 [standard deviations], shape (width + 1, out_size).
    """

    moments: np.ndarray
    cross: np.ndarray
    outputs: np.ndarray
    _maps: dict[bytes, np.ndarray] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def none(cls, in_size: int, out_size: int) -> "LinearPath":
        """Return a path without code, as in a network without linear path."""
        return cls(np.zeros((1, in_size + 1, in_size + 1)), np.zeros((1, in_size + 1, 0)), np.zeros((1, out_size)))

    @classmethod
    def fit(cls, x: np.ndarray, x_out: np.ndarray, width: int) -> "LinearPath":
        """Learn from samples, oldest first.

        Args:
            x: x_in [standard deviations], shape (samples, in_size), complete.
            x_out: x_out [standard deviations], shape (samples, out_size), complete.
            width: Length of the code: the main components of x_out.
        """
        mean, components = basis(x_out, width)
        code, outputs = (x_out - mean) @ components.T, np.concatenate([components, mean[None]])
        rows = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        parts = np.array_split(np.arange(len(rows)), FOLDS)
        weight, whole = np.ones(len(rows)), np.ones(x.shape[1])
        for _ in range(PASSES):
            weighted = rows * weight[:, None]
            path = cls(
                np.stack([weighted[part].T @ rows[part] for part in parts]),
                np.stack([weighted[part].T @ code[part] for part in parts]),
                outputs,
            )
            error = np.linalg.norm(code - rows @ path.map(whole), axis=1)
            limit = ROBUST * np.median(error)
            weight = np.minimum(1.0, limit / np.maximum(error, 1e-12)) if limit > 0.0 else np.ones(len(rows))
        return path

    @property
    def width(self) -> int:
        """Length of the code."""
        return self.cross.shape[2]

    def map(self, gate: np.ndarray) -> np.ndarray:
        """Return the regression under a mask: l = (x_in, 1) map, shape (in_size + 1, width), float32.

        Every element of the code has the strength that predicts the parts of the data best from the other parts.

        Args:
            gate: 1 for the elements of x_in that the mask contains, else 0, shape (in_size,).
        """
        key = np.asarray(gate > 0).tobytes()
        if key not in self._maps:
            self._keep(key, self._map(np.append(np.flatnonzero(gate), len(gate))))
        return self._maps[key]

    def direct(self, gate: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Return the part of the linear path in x_out: its regression times 1 - share, then the share of the network.

        Args:
            gate: See `map`.
            share: Share of the network in every element of x_out, 0 to 1, shape (out_size,).

        Returns:
            Shape (in_size + 2, out_size), float32: x_out = (x_in, 1) direct[:-1] + direct[-1] network.
        """
        line = self.map(gate).astype(float) @ self.outputs[:-1]
        line[-1] += self.outputs[-1]
        return np.concatenate([line * (1.0 - share), share[None]]).astype(np.float32)

    def by_all(self, gate: np.ndarray, element: int) -> np.ndarray:
        """Return the regressions of an element of x_out on all inputs of a mask.

        Args:
            gate: See `map`.
            element: Index of the element in x_out.

        Returns:
            Shape (parts + 1, in_size + 1): learned without each part of the data, and from all of it.
        """
        known = np.append(np.flatnonzero(gate), len(gate))
        result = np.zeros((len(self.moments) + 1, len(gate) + 1))
        result[:, known] = _chosen(self.moments[:, known[:, None], known], self._cross_of(element)[:, known])[..., 0]
        return result

    def by_few(self, gate: np.ndarray, element: int) -> np.ndarray:
        """Return the regression of an element of x_out on as few inputs as do no harm, shape (in_size + 1,).

        Inputs that go together in the training data need not do so beyond it. Weights are shrunk the more, the smaller
        they are, and the fewest inputs are kept whose errors on held-out parts of the data are not clearly larger
        than those of all inputs.

        Args:
            gate: See `map`.
            element: Index of the element in x_out.
        """
        key = np.asarray(gate > 0).tobytes() + element.to_bytes(4)
        if key not in self._maps:
            cross = self._cross_of(element)
            kept = _useful(self.moments, cross, gate)
            lines = np.stack([self.by_all(inputs, element)[-1:].T for inputs in (kept, gate)])
            few, every = _losses(self.moments, cross, np.stack([lines] * len(cross))).sum(axis=(0, 2, 3))
            is_harmful = few - every > MORE**2 * self.moments[:, -1, -1].sum()
            self._keep(key, lines[int(is_harmful), :, 0])
        return self._maps[key]

    def _cross_of(self, element: int) -> np.ndarray:
        """Return the sums of the products of x_in and 1 with an element of x_out, shape (parts, in_size + 1, 1)."""
        line = self.outputs[:, [element]]
        return np.asarray(self.cross @ line[:-1] + self.moments[:, :, -1:] * line[-1])

    def _keep(self, key: bytes, line: np.ndarray) -> None:
        if len(self._maps) >= CACHED:
            self._maps.clear()
        self._maps[key] = line

    def _map(self, known: np.ndarray) -> np.ndarray:
        result = np.zeros(self.cross.shape[1:], np.float32)
        if not self.width:
            return result
        result[known] = _chosen(self.moments[:, known[:, None], known], self.cross[:, known])[-1]
        return result


def _chosen(moments: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """Return regressions of the strength that predicts each part of the data best from the other parts.

    Args:
        moments: Sums of the products of the elements and 1 over each part, shape (parts, n + 1, n + 1).
        cross: Sums of their products with the code, shape (parts, n + 1, width).

    Returns:
        Shape (parts + 1, n + 1, width): learned without each part of the data, and from all of it.
    """
    lines = _regressions(*_left_out(moments, cross))
    best = _losses(moments, cross, lines[:-1]).sum(axis=(0, 2)).argmin(axis=0)
    return np.asarray(lines[:, best, :, np.arange(len(best))].transpose(1, 2, 0))


def _left_out(moments: np.ndarray, cross: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sums over all parts but each, and over all parts, shapes (parts + 1, ...)."""
    whole, total = moments.sum(axis=0), cross.sum(axis=0)
    return np.concatenate([whole - moments, whole[None]]), np.concatenate([total - cross, total[None]])


def _losses(moments: np.ndarray, cross: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Return the terms whose sum is the squared error of lines in each part, less what is the same for all lines.

    Args:
        moments: Sums of the products of the elements and 1 over each part, shape (parts, n + 1, n + 1).
        cross: Sums of their products with the code, shape (parts, n + 1, width).
        lines: Lines that were learned without each part, shape (parts, strengths, n + 1, width).

    Returns:
        Shape (parts, strengths, n + 1, width).
    """
    return np.asarray((moments[:, None] @ lines - 2.0 * cross[:, None]) * lines)


def _useful(moments: np.ndarray, cross: np.ndarray, gate: np.ndarray) -> np.ndarray:
    """Return which of the inputs of a mask are kept; see `LinearPath.by_few`.

    Args:
        moments: As in `LinearPath`.
        cross: Sums of the products of x_in and 1 with the element, shape (parts, in_size + 1, 1).
        gate: See `LinearPath.map`.

    Returns:
        1 for the inputs that are kept, else 0, shape (in_size,).
    """
    known = np.append(np.flatnonzero(gate), len(gate))
    moments, cross = moments[:, known[:, None], known], cross[:, known]
    sets = _left_out(moments, cross)
    weights, lines = _shrunk(*sets)
    counts = np.maximum(moments[:, -1, -1], 1.0)[:, None]  # a part may be empty
    losses = _losses(moments, cross, lines[:-1]).sum(axis=(2, 3)) / counts
    usual = _losses(moments, cross, _regressions(*sets)[:-1]).sum(axis=(2, 3)) / counts
    both = np.concatenate([usual, losses], axis=1)
    more = losses - both[:, [both.mean(axis=0).argmin()]]
    limit = np.minimum(WORSE * more.std(axis=0, ddof=1) / np.sqrt(len(more)), MORE**2)
    is_as_good = more.mean(axis=0) <= limit
    result = np.asarray(gate > 0, float)
    if is_as_good.any():
        size = np.abs(weights[-1, np.flatnonzero(is_as_good)[-1]])
        result[known[:-1]] = size > UNUSED * size.max(initial=0.0)
    return result


def _shrunk(moments: np.ndarray, cross: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return regressions whose small weights vanish, by a ridge penalty of each weight that it sets itself.

    Args:
        moments: Sums of the products of the elements and 1, shape (sets, n + 1, n + 1).
        cross: Sums of their products with one element, shape (sets, n + 1, 1).

    Returns:
        Their weights [standard deviations], shape (sets, strengths, n), and the lines, shape (sets, strengths, n + 1,
        1).
    """
    covariance, along, weight, mean, center = _standardised(moments, cross)
    unit = np.eye(covariance.shape[-1])
    size = np.linalg.solve(covariance + SHRINKS[0] * unit, along)[:, None].repeat(len(SHRINKS), axis=1)
    for _ in range(TURNS):
        scale = np.abs(size)
        scaled = covariance[:, None] * scale * scale.swapaxes(2, 3) + SHRINKS[:, None, None] * unit
        size = scale * np.linalg.solve(scaled, scale * along[:, None])
    lines = size * weight[:, None]
    whole = np.concatenate([lines, center[:, None] - mean.swapaxes(1, 2)[:, None] @ lines], axis=2)
    return size[..., 0], whole


def _regressions(moments: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """Return the regressions of all strengths on several sets of data; the last row of each is the constant.

    Args:
        moments: Sums of the products of the elements and 1, shape (sets, n + 1, n + 1).
        cross: Sums of their products with the code, shape (sets, n + 1, width).

    Returns:
        Shape (sets, strengths, n + 1, width).
    """
    covariance, along, weight, mean, center = _standardised(moments, cross)
    values, turns = np.linalg.eigh(covariance)
    turned = turns.transpose(0, 2, 1) @ along
    shrunk = turned[:, None] / (np.maximum(values, 0.0)[:, None] + RIDGES[:, None])[..., None]
    lines = (turns[:, None] @ shrunk) * weight[:, None]
    return np.concatenate([lines, center[:, None] - mean.transpose(0, 2, 1)[:, None] @ lines], axis=2)


def _standardised(moments: np.ndarray, cross: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return correlations, covariances with the code, inverse standard deviations, and both means, of each set.

    Args:
        moments: See `_regressions`.
        cross: See `_regressions`.

    Returns:
        Shapes (sets, n, n), (sets, n, width), (sets, n, 1), (sets, n, 1) and (sets, 1, width). Elements that do not
        vary have no correlation, and an inverse standard deviation of 0.
    """
    count = moments[:, -1:, -1:]
    mean, center = moments[:, :-1, -1:] / count, cross[:, -1:] / count
    covariance = moments[:, :-1, :-1] / count - mean * mean.transpose(0, 2, 1)
    variance = np.einsum("...ii->...i", covariance)
    is_alive = variance > STILL
    weight = np.where(is_alive, 1.0 / np.sqrt(np.where(is_alive, variance, 1.0)), 0.0)[..., None]
    correlation = covariance * weight * weight.transpose(0, 2, 1)
    return correlation, (cross[:, :-1] / count - mean * center) * weight, weight, mean, center


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
