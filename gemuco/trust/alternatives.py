"""Evidence that is left if the newest blocks are read otherwise: with another p, or with two elements exchanged."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from itertools import combinations

import numpy as np

from gemuco.schema import BodySchema
from gemuco.trust.changes import AGES, LONGEST
from gemuco.trust.config import Hidden
from gemuco.trust.evidence import Evidence, Judge
from gemuco.trust.recent import Recent, View, exchanged
from gemuco.trust.relations import Relations

WATCHED = 6
"""Exchanges are tried of this many elements with the most evidence."""
TRIED = 2
"""At most this number of exchanges is looked at closely, which costs as much as judging a block: those that make the
errors of the watch in the newest block smallest."""
AGES_TRIED = 4
"""With at most this number of ages near that of the alarm."""
APART = 2.0
"""The values of both differ by this much [healthy errors]; else any lie of one would do as the other's value."""
OTHER_TOOL = 0.2
"""Another tool or load is one whose p differs by this share of the range of the trained ones."""
EVERY = slice(None)
"""All columns."""


class Alternatives:
    """Other readings of the newest blocks.

    Args:
        schema: The model in use.
        relations: Its relations.
        recent: The newest blocks.
        judge: Limits and tests.
        hidden: The hidden columns.
    """

    def __init__(self, schema: BodySchema, relations: Relations, recent: Recent, judge: Judge, hidden: Hidden) -> None:
        self._schema, self._relations, self._recent = schema, relations, recent
        self._judge, self._hidden = judge, hidden

    @cached_property
    def _now(self) -> View:
        return self._recent.view(self._relations, self._hidden)

    def under(self, schema: BodySchema, age: int, columns: slice = EVERY) -> Evidence:
        """Return the evidence if the p of a schema holds since about `age` blocks, for the age that leaves least in
        some columns.
        """
        return self._since(self._recent.under(schema, self._relations), age, columns=columns)

    def always(self, schema: BodySchema, columns: slice) -> tuple[Evidence, float]:
        """Return the evidence if the p of a schema held in all of the newest blocks, and the errors of some columns
        relative to those of the model in use (root mean squares).
        """
        view = self._recent.under(schema, self._relations).view(self._relations, self._hidden)
        other, now = (float(np.nansum(each.z[:, columns] ** 2)) for each in (view, self._now))
        return self._judge(view), float(np.sqrt(other / now)) if now > 0.0 else 1.0

    def exchanges(self, evidence: Evidence) -> Iterator[tuple[Hidden, Evidence]]:
        """Yield pairs of elements of one signal with much evidence, and the evidence if they are exchanged back."""
        age = int(evidence.age.flat[evidence.strength.argmax()])
        error = self._now.healthy[-1] * self._judge.scale
        for pair in self._promising(evidence):
            other = self._recent.exchanged(self._schema, self._relations, *pair)
            apart = np.abs(other.values() - self._recent.values())[-age:, pair].mean(axis=0)
            if (apart > APART * error[pair]).all():
                yield frozenset(pair), self._since(other, age, AGES_TRIED)

    def _promising(self, evidence: Evidence) -> list[list[int]]:
        """Return the pairs of one signal whose exchange makes the newest errors of the watch smallest."""
        order = [int(c) for c in np.argsort(-evidence.strength)[:WATCHED] if evidence.ratio[c] > 0.0]
        signals, relations = self._relations.signals, self._relations
        pairs = [list(pair) for pair in combinations(order, 2) if signals[pair[0]] == signals[pair[1]] >= 0]
        newest = self._recent.values()[-1:]
        if not pairs or np.isnan(newest).any():
            return []
        read = [newest, *(exchanged(self._schema, relations, newest, *pair) for pair in pairs)]
        features = relations.features(relations.rows(self._schema, np.concatenate(read)))
        relation = relations.without(self._hidden)
        used = np.delete(relation.errors(features) / relation.std, list(self._hidden), axis=1)
        size = (used**2).reshape(len(read), -1).sum(axis=1)
        return [pairs[k] for k in np.argsort(size[1:])[:TRIED] if size[1 + k] < size[0]]

    def exchanged(self, pair: Hidden, since: int) -> Evidence:
        """Return the evidence if the values of two elements are exchanged since a number of blocks."""
        view = self._recent.exchanged(self._schema, self._relations, *pair).view(self._relations, self._hidden)
        return self._mixed(view, since) if since < LONGEST else self._judge(view)

    def _since(self, other: Recent, age: int, most: int = LONGEST, columns: slice = EVERY) -> Evidence:
        """Return the evidence if the errors are those of other blocks since about `age` blocks.

        At most `most` ages are tried; it is that of the age that leaves least evidence in some columns.
        """
        place, view = AGES.index(age), other.view(self._relations, self._hidden)
        first, last = AGES[max(place - 1, 0)], min(AGES[min(place + 1, len(AGES) - 1)], LONGEST - 1)
        changed = [self._mixed(view, since) for since in range(first, last + 1, 1 + (last - first) // most)]
        return min(changed, key=lambda evidence: evidence.highest_of(columns))

    def _mixed(self, other: View, since: int) -> Evidence:
        z = np.concatenate([self._now.z[:-since], other.z[-since:]])
        z[-since - 1] = np.nan  # the change was within this block
        return self._judge(replace(self._now, z=z, noises=np.full((1, z.shape[1]), np.nan)))


def is_another(schema: BodySchema, bias: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return whether p is that of another tool or load than each of some others, shape (n,)."""
    trained = np.array(list(schema.biases.values()))
    span = np.ptp(trained, axis=0).max() if trained.size else 0.0
    return np.asarray(np.abs(others - bias).max(axis=1, initial=0.0) > OTHER_TOOL * span)
