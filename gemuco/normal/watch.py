"""Closed-form prediction of every element from all others, with or without the rest of its signal.

The network infers the signals that the robot needs. For anomaly detection every relation between the signals counts,
also that of a signal which is inferred too poorly to be an output. The watch is one ridge regression on linear and
quadratic features of the whole sample. Its second moments are enough to predict every element from any set of others,
so a missing sensor needs no new data: the features without it are another part of the same matrix.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

MOST_PAIRS = 27
"""Up to this number of inputs all products of two inputs are features; above, only the squares."""

MOST_SQUARES = 200
"""Above this number of inputs all features are linear."""

MARGIN = 0.1
"""Products are computed from inputs clipped to the range of the samples, wider by this share on both sides."""

LINEAR = 1e-5
"""Ridge penalty of linear features, as a share of their variance."""

PENALTIES = (1e-3, 1e-2, 1e-1, 1e3)
"""Ridge penalties of products, of which held-out blocks choose one per target; the last leaves a linear regression."""

BLOCKS = 5
"""Penalties and weights are chosen by leaving out each of this number of blocks of consecutive samples."""

PRIORS = (0.0, 100.0, 1000.0)
"""Earlier samples count as at most this many samples when the watch learns a body anew; held-out blocks choose."""

NEAR = 0.2
"""The variance of a prediction has this constant part; the rest grows with the distance from the known samples."""

PATTERNS = 16
"""At most this many sets of measured elements are kept."""


class Target(NamedTuple):
    """Elements that are predicted together, each from all inputs outside of the group.

    Attributes:
        elements: Positions of the predicted elements, ascending, shape (n,).
        group: Positions of all inputs that the prediction does not use, shape (m,).
    """

    elements: np.ndarray
    group: np.ndarray


class Reading(NamedTuple):
    """The watch of samples with one set of measured elements, for compiled code.

    Attributes:
        inputs: Positions of the measured inputs, shape (n,).
        clips: Lower and upper clip of products, shape (2, n).
        pairs: Both factors of every product as indices into `inputs`, shape (2, products).
        maps: Residuals by features (1, inputs, products), shape (1 + n + products, residuals).
        target: Position of the element of every residual, shape (residuals,).
        kind: Index of every residual in the watch of complete samples, shape (residuals,).
    """

    inputs: np.ndarray
    clips: np.ndarray
    pairs: np.ndarray
    maps: np.ndarray
    target: np.ndarray
    kind: np.ndarray

    def features(self, rows: np.ndarray) -> np.ndarray:
        """Return the features of samples [standard deviations], shape (n, size) -> (n, features)."""
        x = rows[:, self.inputs]
        clipped, (first, second) = np.clip(x, *self.clips), self.pairs
        return np.concatenate([np.ones((len(x), 1)), x, clipped[:, first] * clipped[:, second]], axis=1)

    def residuals(self, rows: np.ndarray) -> np.ndarray:
        """Return measured minus predicted [standard deviations], shape (n, size) -> (n, residuals)."""
        return self.features(rows) @ self.maps

    def slopes(self, rows: np.ndarray, elements: Sequence[int]) -> np.ndarray:
        """Return derivatives of the residuals of samples, shape (n, size), by elements: (n, residuals, elements)."""
        x = rows[:, self.inputs]
        clipped, (first, second) = np.clip(x, *self.clips), self.pairs
        moves = (x > self.clips[0]) & (x < self.clips[1])
        count, slope = x.shape[1], np.zeros((len(x), self.maps.shape[1], len(elements)))
        for column, element in enumerate(elements):
            for at in np.flatnonzero(self.inputs == element):
                by = np.zeros((len(x), len(self.maps)))
                by[:, 1 + count :] = (first == at) * clipped[:, second]
                by[:, 1 + count :] += (second == at) * clipped[:, first]
                by *= moves[:, at : at + 1]
                by[:, 1 + at] = 1.0
                slope[:, :, column] = by @ self.maps
        return slope


NO_READING = Reading(
    np.zeros(0, int), np.zeros((2, 0)), np.zeros((2, 0), int), np.zeros((1, 0)), np.zeros(0, int), np.zeros(0, int)
)  # fmt: skip
"""A watch that predicts nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Watch:
    """Second moments of the features of a body's samples, and what is predicted from them.

    Attributes:
        inputs: Positions of the inputs in a row, shape (n,); the rows are normalised elements followed by p.
        signal: Signal of every input as a number, shape (n,); -1 for p, which is given and never predicted.
        low: Lower clip of products, shape (n,).
        high: Upper clip of products, shape (n,).
        moments: Mean products of two features, shape (features, features).
        penalties: Ridge penalty of the products for every target, shape (targets,).
        count: Number of samples behind the moments.
    """

    inputs: np.ndarray
    signal: np.ndarray
    low: np.ndarray
    high: np.ndarray
    moments: np.ndarray
    penalties: np.ndarray
    count: float
    _readings: dict[bytes, Reading] = field(default_factory=dict, init=False, repr=False)
    _inverses: dict[float, np.ndarray] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def fit(
        cls,
        rows: np.ndarray,
        signal: np.ndarray,
        before: "Watch | None" = None,
        like: "tuple[np.ndarray, float] | None" = None,
    ) -> "Watch":
        """Learn from complete samples, oldest first.

        Args:
            rows: Samples [standard deviations], then p, shape (samples, size + bias_size); finite where `signal` >= -1.
            signal: Signal of every column as a number; -1 for p, -2 for columns that are not used, shape (columns,).
            before: What was known; its moments count as some of the samples if that predicts held-out blocks better.
            like: Penalties of the targets, and the number of samples for which earlier moments count, if known.
        """
        inputs = np.flatnonzero(signal >= -1)
        x = rows[:, inputs]
        low, high = _wider(x.min(axis=0), x.max(axis=0))
        if before is not None and np.array_equal(before.inputs, inputs):
            low, high = before.low, before.high
        else:
            before = None
        size = _feature_count(len(inputs))
        draft = cls(inputs, signal[inputs], low, high, np.eye(size), np.zeros(0), float(len(rows)))
        features = draft.reading(None, maps=False).features(rows)
        blocks = [features[part] for part in np.array_split(np.arange(len(rows)), BLOCKS)]
        sums = [block.T @ block for block in blocks]
        if like is not None:
            moments = _pooled(np.sum(sums, axis=0), draft.count, before, like[1])
            return cls(inputs, draft.signal, low, high, moments, like[0], draft.count + like[1])
        return draft._chosen(blocks, sums, before)

    def _chosen(self, blocks: list[np.ndarray], sums: list[np.ndarray], before: "Watch | None") -> "Watch":
        """Return the watch with the penalties and the weight of earlier samples that predict left-out blocks best."""
        total, targets = np.sum(sums, axis=0), list(self.targets())

        def left_out(penalties: list[float], prior: float) -> np.ndarray:
            """Return the sum of squared residuals of every target over all blocks, each left out in turn."""
            errors = np.zeros(len(targets))
            for block, own in zip(blocks, sums, strict=True):
                moments = _pooled(total - own, self.count - len(block), before, prior)
                maps = self._maps(moments, targets, penalties)
                errors += [float(np.sum((block @ columns) ** 2)) for columns in maps]
            return errors

        if before is None:
            tried = np.array([left_out([penalty] * len(targets), 0.0) for penalty in PENALTIES])
            penalties, prior, earlier = np.array(PENALTIES)[tried.argmin(axis=0)], 0.0, 0.0
        else:
            penalties = before.penalties
            wrong = {prior: np.log(left_out(penalties.tolist(), prior) + 1e-9).sum() for prior in PRIORS}
            prior = min(wrong, key=lambda weight: wrong[weight])
            earlier = min(prior, before.count)
        moments = _pooled(total, self.count, before, prior)
        return Watch(self.inputs, self.signal, self.low, self.high, moments, penalties, self.count + earlier)

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Number of features, of targets, and of residuals of a complete sample."""
        targets = list(self.targets())
        return _feature_count(len(self.inputs)), len(targets), sum(len(target.elements) for target in targets)

    def targets(self) -> Iterator[Target]:
        """Yield every element alone, then the elements of every signal of several elements, by index into `inputs`."""
        elements = np.flatnonzero(self.signal >= 0)
        for element in elements:
            yield Target(np.array([element]), np.array([element]))
        for number in np.unique(self.signal[elements]):
            group = np.flatnonzero(self.signal == number)
            if 1 < len(group) < len(elements):
                yield Target(group, group)

    def reading(self, finite: np.ndarray | None, maps: bool = True) -> Reading:
        """Return the watch of samples with these finite columns, truth values, shape (columns,); None: all."""
        measured = np.ones(len(self.inputs), bool) if finite is None else finite[self.inputs]
        key = measured.tobytes()
        known = self._readings.get(key) if maps else None
        if known is None:
            known = self._read(measured, maps)
            if len(self._readings) >= PATTERNS:
                self._readings.clear()
            if maps:
                self._readings[key] = known
        return known

    def _read(self, measured: np.ndarray, maps: bool) -> Reading:
        place = np.cumsum(measured) - 1
        first, second = _pairs(len(self.inputs))
        usable = measured[first] & measured[second]
        kept = self.kept(measured)
        parts, target, kind, start = [np.zeros((int(kept.sum()), 0))], [], [], 0
        chosen = []
        for entry, penalty in zip(self.targets(), self.penalties, strict=True) if maps else ():
            present = measured[entry.elements]
            others = np.setdiff1d(np.flatnonzero(measured & (self.signal >= 0)), entry.group)
            if present.any() and len(others):
                chosen.append((Target(entry.elements[present], entry.group[measured[entry.group]]), penalty))
                target.append(self.inputs[entry.elements[present]])
                kind.append(start + np.flatnonzero(present))
            start += len(entry.elements)
        if chosen:
            targets, penalties = zip(*chosen, strict=True)
            parts += self._maps(self.moments, list(targets), list(penalties), kept)
        return Reading(
            self.inputs[measured],
            np.stack([self.low[measured], self.high[measured]]),
            np.stack([place[first[usable]], place[second[usable]]]),
            np.ascontiguousarray(np.concatenate(parts, axis=1)),
            np.concatenate([np.zeros(0, int), *target]),
            np.concatenate([np.zeros(0, int), *kind]),
        )

    def kept(self, measured: np.ndarray) -> np.ndarray:
        """Return the features that only measured inputs enter, truth values: shape (inputs,) -> (features,)."""
        first, second = _pairs(len(self.inputs))
        return np.concatenate([[True], measured, measured[first] & measured[second]])

    def inverse(self, penalty: float) -> np.ndarray:
        """Return the inverse of the moments with a ridge penalty of the products, shape (features, features)."""
        known = self._inverses.get(penalty)
        if known is None:
            known = self._inverses[penalty] = np.asarray(np.linalg.inv(self.moments + self._ridge(penalty)))
        return known

    def _ridge(self, penalty: float) -> np.ndarray:
        ridge = np.full(len(self.moments), penalty)
        ridge[0], ridge[1 : 1 + len(self.inputs)] = 1e-9, LINEAR
        return np.diag(ridge)

    def _maps(
        self, moments: np.ndarray, targets: list[Target], penalties: list[float], kept: np.ndarray | None = None
    ) -> list[np.ndarray]:
        """Return residuals by features for every target, shape (features, elements of the target).

        With H the inverse of the regularised moments, the residual of the features B that contain the group, given all
        others, is inv(H_BB) (H phi)_B: one inverse serves all targets.
        """
        count = len(self.inputs)
        first, second = _pairs(count)
        used = np.ones(len(moments), bool) if kept is None else kept
        position = np.cumsum(used) - 1
        result: list[np.ndarray | None] = [None] * len(targets)
        for penalty in sorted(set(penalties)):
            inverse = np.linalg.inv((moments + self._ridge(penalty))[np.ix_(used, used)])
            for index, target in enumerate(targets):
                if penalties[index] != penalty:
                    continue
                member = np.zeros(count, bool)
                member[target.group] = True
                inside = np.concatenate([[False], member, member[first] | member[second]]) & used
                block = position[inside]
                residual = np.linalg.solve(inverse[np.ix_(block, block)], inverse[block])
                result[index] = residual[np.searchsorted(block, position[1 + target.elements])].T
        return [maps for maps in result if maps is not None]


def without_features(inverse: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Return the inverse of the moments of the features that remain, zero for the others, shape (features, features).

    Args:
        inverse: Inverse of the moments of all features, shape (features, features).
        outside: The features to leave out, truth values, shape (features,).
    """
    if not outside.any():
        return inverse
    block = inverse[outside]
    result = inverse - block.T @ np.linalg.solve(block[:, outside], block)
    result[outside] = result[:, outside] = 0.0
    return result


def error_growth(far: np.ndarray, distance: np.ndarray | float) -> np.ndarray:
    """Return how much larger errors are at distances from the known samples than at their mean distance."""
    return np.asarray(np.sqrt((NEAR * distance + far) / ((1.0 + NEAR) * distance)))


def _pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return both factors of every product of `count` inputs."""
    if count <= MOST_PAIRS:
        first, second = np.triu_indices(count)
        return first, second
    same = np.arange(count if count <= MOST_SQUARES else 0)
    return same, same


def _feature_count(count: int) -> int:
    return 1 + count + len(_pairs(count)[0])


def _wider(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    margin = MARGIN * (high - low) + 1e-9
    return low - margin, high + margin


def _pooled(total: np.ndarray, count: float, before: Watch | None, prior: float) -> np.ndarray:
    """Return mean moments of a sum over `count` samples and of earlier moments that count as `prior` samples."""
    if before is None or not prior:
        return total / count
    weight = min(prior, before.count)
    return (total + weight * before.moments) / (count + weight)
