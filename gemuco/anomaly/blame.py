"""Which element is wrong: the one whose free choice would make a whole window of samples most normal.

For every candidate the hypothesis is that its values say nothing, over all the samples. Its values are then chosen so
that the prediction errors become as normal as they can; what remains, and what the freedom costs (two elements always
explain more than one), tells how good the hypothesis is. One wrong element upsets every prediction that is made from
it, so the largest contributor is often not the culprit.

Candidates are the single elements, and parts: elements of one name in several signals. A muscle has a tension and a
length, and when it is cut neither goes with the joints any more. The others then pull its joint away, which is nearly
what a wrong joint sensor looks like; so a part that says what training never saw (no tension at all) is preferred.
"""

from typing import NamedTuple

import numpy as np

from gemuco.anomaly.prediction import judging_masks, prediction_errors
from gemuco.layers import push, trace
from gemuco.normal import Normal
from gemuco.schema import BodySchema

ANYTHING = 3.0
"""How far a wrong value may be from what is right [standard deviations of the signal]."""
REFINED = 5
"""Candidates of a kind, the best, whose values are found anew from where the first step led."""
STRANGE = 0.2
"""What remains under a part counts so much less if the part says what training never saw."""


class Suspect(NamedTuple):
    """A candidate.

    Attributes:
        name: `signal.element`; of a part, the element that explains most by itself.
        elements: Positions in the layout.
        remains: Share of the squared distances of the samples that is left if this is wrong, its cost included; less
            for a part that says what training never saw.
    """

    name: str
    elements: tuple[int, ...]
    remains: float


def suspects(schema: BodySchema, rows: np.ndarray) -> list[Suspect]:
    """Every candidate, the most suspect first; empty without normal data or without anything to judge.

    Args:
        schema: With statistics of the normal.
        rows: Samples [standard deviations], shape (n, size). Only those that lack no more than the most complete count.
    """
    normal = schema.normal
    if normal is None or not len(rows):
        return []
    there = np.isfinite(prediction_errors(schema, rows)) & np.isfinite(normal.mean)
    pattern = there[int(np.argmax(there.sum(axis=1)))]
    if not pattern.any():
        return []
    case = _Case(schema, normal, rows[(there == pattern).all(axis=1)], np.flatnonzero(pattern))
    single = _ranked(case, [(index,) for index in case.movable])
    shared = _ranked(case, parts(schema, case.movable))
    found = [Suspect(schema.layout.element(s[0]), s, left) for s, left in single.items()]
    for part, left in shared.items():
        share = STRANGE if case.is_strange(part) else 1.0
        found.append(Suspect(schema.layout.element(min(part, key=lambda i: single[(i,)])), part, share * left))
    return sorted(found, key=lambda suspect: suspect.remains)


def parts(schema: BodySchema, movable: list[int]) -> list[tuple[int, ...]]:
    """Elements of one name in several signals, as positions in the layout; axes and numbers (`x`, `3`) are no names."""
    named: dict[str, list[int]] = {}
    for index in movable:
        name = schema.layout.element(index).partition(".")[2]
        if len(name) > 1 and name.isidentifier():
            named.setdefault(name, []).append(index)
    return [tuple(indices) for indices in named.values() if len(indices) > 1]


class _Case:
    """Samples that lack the same elements, and how their errors answer to every element."""

    def __init__(self, schema: BodySchema, normal: Normal, rows: np.ndarray, judged: np.ndarray) -> None:
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
        masks = schema.derived(judging_masks)
        predicted = {mask: self._predicted(mask, rows, elements) for mask in set(masks.values())}
        for name, mask in masks.items():
            out, span = schema.out_layout.slice(name), schema.layout.slice(name)
            slope[:, out] = -predicted[mask][:, out]
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

    def is_strange(self, group: tuple[int, ...]) -> bool:
        """Whether some element of a group is out of the range of the training data in most samples."""
        scaler, index = self._schema.scaler, list(group)
        low = scaler.normalise(scaler.low)[index]
        high = scaler.normalise(scaler.high)[index]
        values = self._rows[:, index]
        return bool((((values < low) | (values > high)).mean(axis=0) > 0.5).any())

    def remains(self, group: tuple[int, ...], passes: int = 1) -> float:
        """Share of the squared distances that is left if a group of elements is wrong in all samples."""
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
        return float(np.sum(left + cost)) / max(float(np.sum(self._error**2)), 1e-9)


def _ranked(case: _Case, candidates: list[tuple[int, ...]]) -> dict[tuple[int, ...], float]:
    """What remains under every candidate, the best of them judged twice."""
    found = {candidate: case.remains(candidate) for candidate in candidates}
    for candidate in sorted(found, key=found.__getitem__)[:REFINED]:
        found[candidate] = case.remains(candidate, 2)
    return found
