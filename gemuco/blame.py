"""Which element is wrong: the one whose free choice would make a whole window of samples most normal.

For every candidate the hypothesis is that its values say nothing, over all the samples. Its values are then chosen so
that the prediction errors become as normal as they can, and the evidence of that is what is left of the squared
distances, plus what the freedom costs: two elements always explain more than one. One wrong element upsets every
prediction that is made from it, so the largest contributor is often not the culprit.

Candidates are the single elements, and the elements of one name in several signals: a muscle has a tension and a
length, and when it is cut neither goes with the joints any more.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gemuco.kernels import push, trace
from gemuco.normal import Normal, prediction_errors

if TYPE_CHECKING:
    from gemuco.schema import BodySchema

ANYTHING = 3.0
"""How far a wrong value may be from what is right [standard deviations of the signal]."""
REFINED = 6
"""Candidates of most evidence whose values are found anew from where the first step led."""


class Suspect(NamedTuple):
    """A candidate.

    Attributes:
        name: `signal.element`; of a group, the element that explains most by itself.
        elements: Positions in the layout.
        evidence: Logarithm of how much more likely the samples are if this is wrong than if nothing is.
    """

    name: str
    elements: tuple[int, ...]
    evidence: float


def suspects(schema: "BodySchema", rows: np.ndarray) -> list[Suspect]:
    """Every candidate, the most suspect first.

    Args:
        schema: With statistics of the normal.
        rows: Samples [standard deviations], shape (n, size). Only those with all that the most complete one has count.

    Returns:
        Empty without normal data or without anything to judge.
    """
    normal = schema.normal
    errors = prediction_errors(schema, rows)
    if normal is None or not len(rows):
        return []
    there = np.isfinite(errors) & np.isfinite(normal.mean)
    complete = there.sum(axis=1) == there.sum(axis=1).max()
    pattern = there[complete][0]
    if not pattern.any():
        return []
    same = (there == pattern).all(axis=1)
    case = _Case(schema, normal, rows[same], np.flatnonzero(pattern))
    single = {index: case.evidence((index,)) for index in case.movable}
    found = [(evidence, (index,)) for index, evidence in single.items()]
    found += [(case.evidence(group), group) for group in groups(schema, case.movable)]
    found.sort(key=lambda entry: -entry[0])
    found[:REFINED] = sorted(((case.evidence(group, 2), group) for _, group in found[:REFINED]), key=lambda e: -e[0])
    return [Suspect(schema.layout.element(max(group, key=single.__getitem__)), group, e) for e, group in found]


def groups(schema: "BodySchema", movable: list[int]) -> list[tuple[int, ...]]:
    """Elements of one name in several signals, as positions in the layout."""
    named: dict[str, list[int]] = {}
    for index in movable:
        named.setdefault(schema.layout.element(index).partition(".")[2], []).append(index)
    return [tuple(indices) for indices in named.values() if len(indices) > 1]


class _Case:
    """Samples that lack the same elements, and how their errors answer to every element."""

    def __init__(self, schema: "BodySchema", normal: Normal, rows: np.ndarray, judged: np.ndarray) -> None:
        self._schema, self._rows, self._judged = schema, rows, judged
        self._mean = normal.mean[judged]
        covariance = normal.covariance[np.ix_(judged, judged)]
        self._whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        self.movable = np.flatnonzero(np.isfinite(rows).all(axis=0)).tolist()
        self._error, self._slope = self._at(rows, self.movable)

    def _at(self, rows: np.ndarray, elements: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Whitened errors (n, judged) and their derivatives by elements (n, judged, elements)."""
        schema = self._schema
        error = prediction_errors(schema, rows)[:, self._judged] - self._mean
        slope = np.zeros((len(rows), schema.out_layout.size, len(elements)))
        for name, mask in schema.judges.items():
            out, span = schema.out_layout.slice(name), schema.layout.slice(name)
            slope[:, out] = -self._predicted(mask, rows, elements)[:, out]
            for column, element in enumerate(elements):
                if span.start <= element < span.stop:
                    slope[:, out.start + element - span.start, column] += 1.0
        slope *= schema.scaler.std[schema.out_index][:, None]
        return error @ self._whiten.T, np.einsum("ij,njk->nik", self._whiten, slope[:, self._judged])

    def _predicted(self, mask: frozenset[str], rows: np.ndarray, elements: list[int]) -> np.ndarray:
        """Derivatives of the prediction under a mask by elements, shape (n, out_size, elements)."""
        schema = self._schema
        chain = schema.weights.whole
        inputs = schema.network_input(rows, mask)
        values = trace(chain, inputs)
        through, _ = schema.gate(mask)
        found = np.zeros((len(rows), schema.out_layout.size, len(elements)))
        for column, element in enumerate(elements):
            place = np.flatnonzero(schema.in_index == element)
            if len(place) and through[place[0]] > 0:
                tangent = np.zeros_like(inputs)
                tangent[:, place[0]] = 1.0
                found[:, :, column] = push(chain, values, tangent)
        return found

    def evidence(self, group: tuple[int, ...], passes: int = 1) -> float:
        """Logarithm of how much more likely the samples are if a group of elements is wrong in all of them."""
        elements = list(group)
        error, slope = self._error, self._slope[:, :, [self.movable.index(e) for e in elements]]
        moved = np.zeros((len(self._rows), len(elements)))
        prior = np.eye(len(elements)) / ANYTHING**2
        for index in range(passes):
            if index:
                rows = self._rows.copy()
                rows[:, elements] += moved
                error, slope = self._at(rows, elements)
                error = error - np.einsum("nik,nk->ni", slope, moved)
            information = np.einsum("nij,nik->njk", slope, slope) + prior
            moved = -np.linalg.solve(information, np.einsum("nij,ni->nj", slope, error)[..., None])[..., 0]
        left = np.sum((error + np.einsum("nik,nk->ni", slope, moved)) ** 2, axis=1)
        left += np.sum(moved**2, axis=1) / ANYTHING**2
        cost = np.linalg.slogdet(information)[1] + 2.0 * len(elements) * np.log(ANYTHING)
        return 0.5 * float(np.sum(np.sum(self._error**2, axis=1) - left - cost))
