"""Errors of the network, and what they say of every column: how far it would have to be wrong to explain them.

Where the network predicts a signal better than the watch does, a small lie shows in the network's errors only. An error
of the tip of an arm may come from the camera or from any joint; its derivatives show which lie of which size would
explain it. Hidden columns may be wrong by any amount, so the directions in which they move the errors do not count.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from gemuco.anomaly.prediction import judging_masks
from gemuco.layers import pull, trace
from gemuco.masks import Mask
from gemuco.schema import BodySchema
from gemuco.trust.config import Hidden

LINEAR = 0.5
"""The derivatives hold while hidden columns are wrong by at most this [standard deviations of the signal]."""
LEAST = 1e-4
"""The errors say nothing of a column with less information than this."""
FREE = 1e-9
"""This share of the largest information keeps inverses finite in directions without any."""


class Sensed(NamedTuple):
    """Evidence of the network's errors against every column.

    Attributes:
        information: How much they say of every two columns: the errors' derivatives by both, weighted by the precision
            of healthy errors [1 / standard deviations squared], shape (n, columns, columns).
        evidence: The errors' derivatives by every column, times the errors, weighted so, shape (n, columns).
    """

    information: np.ndarray
    evidence: np.ndarray

    @classmethod
    def of(cls, errors: np.ndarray, slopes: np.ndarray, precision: np.ndarray) -> "Sensed":
        """Weigh errors.

        Args:
            errors: Measured minus predicted [standard deviations], shape (n, errors).
            slopes: Their derivatives by every judged column, shape (n, errors, columns).
            precision: Inverse of the covariance of healthy errors, shape (errors, errors).
        """
        turned = slopes.transpose(0, 2, 1) @ precision
        return cls(turned @ slopes, (turned @ errors[:, :, None])[:, :, 0])

    @classmethod
    def joined(cls, parts: Iterable["Sensed"]) -> "Sensed":
        """Return parts one after the other."""
        return cls(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


class _Judging(NamedTuple):
    """Errors of outputs that are judged by one mask.

    Attributes:
        mask: The mask.
        errors: Their numbers, shape (k,).
        outputs: Positions of the outputs in x_out, shape (k,).
        columns: Judged columns that the mask contains, by their number, shape (m,).
        places: Their positions in the network's input, shape (m,).
    """

    mask: Mask
    errors: np.ndarray
    outputs: np.ndarray
    columns: np.ndarray
    places: np.ndarray

    @classmethod
    def of(cls, schema: BodySchema, mask: Mask, columns: np.ndarray, index: np.ndarray) -> "_Judging":
        """Return what is judged by a mask.

        Args:
            schema: The body schema.
            mask: The mask.
            columns: Positions of the judged columns in the layout, then p.
            index: Positions in x_out of all errors.
        """
        size, through = schema.layout.size, schema.gate(mask).through
        place = {int(at): number for number, at in enumerate(schema.in_index) if through[number] > 0}
        place |= {size + number: number - len(schema.bias) for number in range(len(schema.bias))}
        known = [number for number, column in enumerate(columns) if int(column) in place]
        names = [name for name, own in schema.derived(judging_masks).items() if own == mask]
        errors = np.flatnonzero(np.isin(index, schema.out_layout.indices(names)))
        places = np.array([place[int(columns[number])] for number in known], int)
        return cls(mask, errors, index[errors], np.array(known, int), places)


class Sensitivity:
    """The errors of those outputs that the network predicts better than the watch does."""

    def __init__(self, schema: BodySchema, columns: np.ndarray) -> None:
        """Prepare for judged columns: positions in the layout, then p."""
        assert schema.normal is not None
        outputs, std = schema.out_layout.size, schema.scaler.std[schema.out_index]
        self._index = np.flatnonzero(np.isfinite(schema.normal.mean[:outputs]))
        self._columns = columns
        place = np.ix_(self._index, self._index)
        covariance = schema.normal.covariance[:outputs, :outputs] / np.outer(std, std)
        self._mean = schema.normal.mean[:outputs][self._index] / std[self._index]
        self._judging: dict[str, Mask] = {}
        self._judgings: list[_Judging] = []
        self._own = [np.flatnonzero(schema.out_index[self._index] == column) for column in columns]
        self._precision = np.linalg.inv(covariance[place]) if len(self._index) else np.zeros((0, 0))

    def sense(self, schema: BodySchema, rows: np.ndarray) -> Sensed:
        """Return what the errors of samples followed by p say, shape (n, size + bias_size)."""
        return Sensed.of(*self.errors(schema, rows), self._precision)

    def along(self, schema: BodySchema, rows: np.ndarray, weights: np.ndarray) -> Sensed:
        """Return what the weighted mean of the errors of some rows says, with the derivatives at the first one.

        Args:
            schema: The schema.
            rows: Samples followed by p, shape (n, size + bias_size).
            weights: Their weights, shape (n,).
        """
        errors, slopes = self.errors(schema, rows)
        return Sensed.of(weights @ errors[None], slopes[:1], self._precision)

    def errors(self, schema: BodySchema, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors of samples followed by p, shape (n, size + bias_size), and their derivatives.

        Returns:
            Measured minus predicted [standard deviations], zero where a value is missing, shape (n, errors), and their
            derivatives by every judged column, shape (n, errors, columns).
        """
        size = schema.layout.size
        if not len(rows) or (rows[:, size:] == schema.bias).all():
            return self._of_bias(schema, rows[:, :size])
        biases, owner = np.unique(rows[:, size:], axis=0, return_inverse=True)
        errors = np.zeros((len(rows), len(self._index)))
        slopes = np.zeros((len(rows), len(self._index), len(self._columns)))
        for number, bias in enumerate(biases):
            of = owner.reshape(-1) == number
            errors[of], slopes[of] = self._of_bias(schema.with_bias(bias), rows[of, :size])
        return errors, slopes

    def _of_bias(self, schema: BodySchema, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors of samples, shape (n, size), under the p of a schema, and their derivatives."""
        errors = np.zeros((len(x), len(self._index)))
        slopes = np.zeros((*errors.shape, len(self._columns)))
        for judging in self._judgings_of(schema):
            predicted = schema.infer(x, judging.mask)[:, judging.outputs].astype(float)
            predicted[~np.isfinite(x[:, schema.layout.indices(judging.mask)]).all(axis=1)] = np.nan
            errors[:, judging.errors] = x[:, schema.out_index[judging.outputs]] - predicted
            chain, inputs = schema.chain(judging.mask), schema.network_input(np.nan_to_num(x), judging.mask)
            gradients = np.zeros((len(judging.outputs), len(x), schema.out_layout.size), inputs.dtype)
            gradients[np.arange(len(judging.outputs)), :, judging.outputs] = 1.0
            pulled = pull(chain, trace(chain, inputs), gradients)[:, :, judging.places]
            slopes[np.ix_(np.arange(len(x)), judging.errors, judging.columns)] = -pulled.transpose(1, 0, 2)
        for number, own in enumerate(self._own):
            slopes[:, own, number] += 1.0
        return np.nan_to_num(errors - self._mean), slopes

    def _judgings_of(self, schema: BodySchema) -> list[_Judging]:
        """Return what each mask judges; an update of W may choose other masks."""
        judging = schema.derived(judging_masks)
        if judging != self._judging:
            masks = dict.fromkeys(judging.values())
            judgings = (_Judging.of(schema, mask, self._columns, self._index) for mask in masks)
            self._judging, self._judgings = judging, [own for own in judgings if len(own.errors)]
        return self._judgings

    def lies(self, sensed: Sensed, hidden: Hidden, limit: float = LINEAR) -> tuple[np.ndarray, np.ndarray]:
        """Return the lie of every column that alone would explain the errors, and its standard deviation.

        Both have the shape (n, columns) [standard deviations of the signal]; the second is infinite where the errors
        say nothing of a column, or where a hidden column is off by more than the limit, so that no derivative holds.
        """
        value, spread = np.zeros(sensed.evidence.shape), np.full(sensed.evidence.shape, np.inf)
        if not len(self._index):
            return value, spread
        away = sorted(hidden)
        information, evidence, free = np.einsum("ncc->nc", sensed.information), sensed.evidence, np.zeros((1, 1))
        if hidden:
            # what is left of the other columns where the hidden ones may be wrong by any amount
            across = sensed.information[:, :, away]
            free = FREE * (1.0 + information[:, away].max(axis=1))[:, None]
            inverse = np.linalg.inv(across[:, away] + free[:, :, None] * np.eye(len(away)))
            taken = across @ inverse
            information = information - np.einsum("nch,nch->nc", taken, across)
            evidence = evidence - (taken @ evidence[:, away, None])[:, :, 0]
            # a hidden column may be wrong by any amount where the other hidden ones are too
            own = 1.0 / np.einsum("nhh->nh", inverse)
            information[:, away] = own - free
            evidence[:, away] = (inverse @ sensed.evidence[:, away, None])[:, :, 0] * own
        known = information > LEAST + 2.0 * free
        divisor = np.where(known, information, 1.0)
        value, spread = np.where(known, evidence, 0.0) / divisor, np.where(known, divisor**-0.5, np.inf)
        if hidden:
            far = (np.abs(value[:, away]) > limit).any(axis=1)
            spread[far] = np.inf
        return value, spread

    def moved(self, sensed: Sensed, hidden: Hidden, changes: np.ndarray) -> np.ndarray:
        """Return the lies that changes of all columns would suggest, shape (n, k, columns) like the changes."""
        count, information = changes.shape[1], sensed.information
        evidence = (changes @ information).reshape(-1, changes.shape[2])
        value, _ = self.lies(Sensed(np.repeat(information, count, axis=0), evidence), hidden, limit=np.inf)
        return value.reshape(changes.shape)
