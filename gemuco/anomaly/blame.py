"""The wrong element: the one whose free choice makes a window of samples most normal.

For every candidate the hypothesis is that its values are arbitrary in all samples. They are then chosen so that the
prediction errors become as normal as possible; the remaining distance, and a cost of the freedom (two elements always
explain more than one), rate the hypothesis. One wrong element disturbs every prediction that is made from it, so the
largest contributor is often not the cause.

Candidates are single elements, and parts: elements of one name in several signals. A muscle has a tension and a length,
and when it is cut neither fits the joints any more. The others then pull its joint away, which looks much like a wrong
joint sensor; so a part with values outside of the training data (no tension at all) is preferred.
"""

from typing import NamedTuple

import numpy as np

from gemuco.anomaly.prediction import Judgement, all_errors, judgements, judging_masks, with_bias
from gemuco.layers import push, trace
from gemuco.schema import BodySchema

ANYTHING = 3.0
"""A wrong value is this far from the right one [standard deviations of the signal]."""
REFINED = 5
"""This many best candidates of a kind are linearised a second time, at the end of their first step."""
STRANGE = 0.2
"""The remaining distance of a part is multiplied by this if its values lie outside of the training data."""


class Suspect(NamedTuple):
    """A candidate for the wrong element.

    Attributes:
        name: `signal.element`; of a part, the element that explains most by itself.
        elements: Positions in the layout.
        remains: Share of the squared distances of the samples that remains if these elements are wrong, with the cost
            of their freedom; less for a part with values outside of the training data.
    """

    name: str
    elements: tuple[int, ...]
    remains: float


def suspects(schema: BodySchema, rows: np.ndarray) -> list[Suspect]:
    """Return every candidate, the most suspect first; none if no error can be judged.

    Args:
        schema: A schema with statistics of prediction errors.
        rows: Samples [standard deviations], shape (n, size). Only those as complete as the most complete one count.
    """
    if schema.normal is None or not len(rows):
        return []
    finite = np.isfinite(rows)
    count = {pattern.tobytes(): len(schema.derived(judgements)(pattern).judged.place) for pattern in finite}
    pattern = max(finite, key=lambda measured: count[measured.tobytes()])
    if not count[pattern.tobytes()]:
        return []
    case = _Case(schema, schema.derived(judgements)(pattern), rows[(finite == pattern).all(axis=1)])
    single = _ranked(case, [(index,) for index in case.movable])
    shared = _ranked(case, parts(schema, case.movable))
    candidates = [Suspect(schema.layout.element(s[0]), s, left) for s, left in single.items()]
    for part, left in shared.items():
        share = STRANGE if case.is_strange(part) else 1.0
        candidates.append(Suspect(schema.layout.element(min(part, key=lambda i: single[(i,)])), part, share * left))
    return sorted(candidates, key=lambda suspect: suspect.remains)


def parts(schema: BodySchema, movable: list[int]) -> list[tuple[int, ...]]:
    """Return positions of elements with one name in several signals; axes and numbers (`x`, `3`) are not names."""
    named: dict[str, list[int]] = {}
    for index in movable:
        name = schema.layout.element(index).partition(".")[2]
        if len(name) > 1 and name.isidentifier():
            named.setdefault(name, []).append(index)
    return [tuple(indices) for indices in named.values() if len(indices) > 1]


class _Case:
    """Samples that lack the same elements, and the derivatives of their errors by every element."""

    def __init__(self, schema: BodySchema, by: Judgement, rows: np.ndarray) -> None:
        self._schema, self._rows, self._by = schema, rows, by.judged
        self._mean = by.judged.mean[by.judged.place]
        self._whiten = np.linalg.cholesky(by.judged.precision).T
        self.movable = np.flatnonzero(np.isfinite(rows).all(axis=0)).tolist()
        self._error, self._slope = self._at(rows, self.movable)

    def _at(self, rows: np.ndarray, elements: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened errors (n, judged) and their derivatives by elements (n, judged, elements)."""
        schema, reading, index = self._schema, self._by.reading, self._by.place
        whole = with_bias(schema, rows)
        error = all_errors(schema, reading, whole, len(self._by.mean))[:, index] - self._mean
        outputs = schema.out_layout.size
        slope = np.zeros((len(rows), len(self._by.mean), len(elements)))
        masks = schema.derived(judging_masks)
        predicted = {mask: self._predicted(mask, rows, elements) for mask in set(masks.values())}
        for name, mask in masks.items():
            out, span = schema.out_layout.slice(name), schema.layout.slice(name)
            slope[:, out] = -predicted[mask][:, out]
            for column, element in enumerate(elements):
                if span.start <= element < span.stop:
                    slope[:, out.start + element - span.start, column] += 1.0
        slope[:, :outputs] *= schema.scaler.std[schema.out_index][:, None]
        slope[:, outputs + reading.kind] = reading.slopes(whole, elements)
        return error @ self._whiten.T, np.einsum("ij,njk->nik", self._whiten, slope[:, index])

    def _predicted(self, mask: frozenset[str], rows: np.ndarray, elements: list[int]) -> np.ndarray:
        """Return derivatives of the prediction under a mask by elements, shape (n, out_size, elements)."""
        schema = self._schema
        chain = schema.chain(mask)
        inputs = schema.network_input(rows, mask)
        values = trace(chain, inputs)
        through = schema.gate(mask).through
        slope = np.zeros((len(rows), schema.out_layout.size, len(elements)))
        for column, element in enumerate(elements):
            position = np.flatnonzero(schema.in_index == element)
            if len(position) and through[position[0]] > 0:
                tangent = np.zeros_like(inputs)
                tangent[:, position[0]] = 1.0
                slope[:, :, column] = push(chain, values, tangent)
        return slope

    def is_strange(self, group: tuple[int, ...]) -> bool:
        """Whether an element of a group is outside of the training data in most samples."""
        scaler, index = self._schema.scaler, list(group)
        low = scaler.normalise(scaler.low)[index]
        high = scaler.normalise(scaler.high)[index]
        values = self._rows[:, index]
        return bool((((values < low) | (values > high)).mean(axis=0) > 0.5).any())

    def remains(self, group: tuple[int, ...], passes: int = 1) -> float:
        """Return the share of the squared distances that remains if a group of elements is wrong in all samples."""
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
        remaining = np.sum((error + np.einsum("nik,nk->ni", slope, moved)) ** 2, axis=1)
        remaining += np.sum(moved**2, axis=1) / ANYTHING**2
        cost = np.linalg.slogdet(information)[1] + 2.0 * len(elements) * np.log(ANYTHING)
        return float(np.sum(remaining + cost)) / max(float(np.sum(self._error**2)), 1e-9)


def _ranked(case: _Case, candidates: list[tuple[int, ...]]) -> dict[tuple[int, ...], float]:
    """Return the remaining distance of every candidate, linearised twice for the best of them."""
    remaining = {candidate: case.remains(candidate) for candidate in candidates}
    for candidate in sorted(remaining, key=remaining.__getitem__)[:REFINED]:
        remaining[candidate] = case.remains(candidate, 2)
    return remaining
