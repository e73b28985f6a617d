"""Inspection of recorded samples: which sensors lied, from when to when, and what they should have read."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gemuco.errors import NotEnoughData, SchemaError, WrongSize
from gemuco.estimation import estimate, tried_recipes
from gemuco.schema import BodySchema, check_schema
from gemuco.trust.changes import LONGEST
from gemuco.trust.config import BLOCK, Finding, TrustConfig
from gemuco.trust.monitor import TrustMonitor
from gemuco.trust.relations import Relations

LASTS = 10
"""A contradiction that no element explains is reported after this number of blocks."""


@dataclass(frozen=True, slots=True)
class Lie:
    """Elements whose values the others contradict for some time.

    Attributes:
        elements: Names of the elements, the most suspicious first; empty if no element explains what is seen.
        cause: `element`, `either` of several that look alike, `all` of them, `part` of the body, `environment` (another
            tool), or `body`.
        kind: `frozen`, `offset`, `wrap`, `drift`, `gain`, `sign`, `clipped`, `swapped`, `noise` or `unknown`.
        start: Time of the first wrong sample [s since the first sample].
        end: Time of the first sample that is right again [s]; the end of the samples if there is none.
        size: Root mean square of measured minus predicted [unit of the first element]; NaN if unknown.
        is_hidden: Whether the elements are wrong beyond doubt; if not, `reason` says why they were used.
        reason: Why they were used; empty if they were not.
    """

    elements: tuple[str, ...]
    cause: str
    kind: str
    start: float
    end: float
    size: float
    is_hidden: bool
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Inspection:
    """Lies in a sequence of samples, and the samples without them.

    Attributes:
        lies: All lies, in the order of their start.
        hidden: Whether each value must not be used as measured: signal -> array of shape (samples, n).
        values: The samples with estimates in place of hidden values [unit]: signal -> array of shape (samples, n); NaN
            where there is none.
        std: Expected errors of these estimates [unit], in the same shapes; 0 where a value was used as measured.
    """

    lies: tuple[Lie, ...]
    hidden: dict[str, np.ndarray]
    values: dict[str, np.ndarray]
    std: dict[str, np.ndarray]


def inspect(
    schema: BodySchema, samples: Mapping[str, np.ndarray], rate: float, config: TrustConfig | None = None
) -> Inspection:
    """Find sensors that lied in recorded samples of the body.

    Args:
        schema: The model, with normal errors.
        samples: Signal -> values in the order of time [unit], shape (samples, n); NaN where not measured.
        rate: Samples per second [Hz].
        config: The settings.

    Raises:
        SchemaError: The samples do not fit the model, or the rate is not positive.
        NotEnoughData: What is normal for the model is not known.
    """
    return Inspector(schema, rate, config).inspect(samples)


@dataclass(slots=True)
class _Open:
    """A finding that is followed from block to block, and the samples from `start` until before `end` that it covers.

    Attributes:
        finding: The finding as it was seen last.
        start: Number of the first wrong sample.
        end: Number of the sample after the last one that is wrong.
        seen: Number of blocks in which it was seen.
        was_hidden: Whether its elements were hidden once.
    """

    finding: Finding
    start: int
    end: int
    seen: int = 0
    was_hidden: bool = False

    def is_same(self, other: Finding) -> bool:
        """Whether a finding of the next block is about the same elements, or neither is about any."""
        own = self.finding
        return bool(set(own.elements) & set(other.elements)) or (
            own.elements == other.elements and own.cause == other.cause
        )

    @property
    def matters(self) -> bool:
        """Whether it is more than a suspicion that lapsed."""
        return self.was_hidden or bool(self.finding.reason) or (self.finding.cause == "body" and self.seen >= LASTS)


class Inspector:
    """The same for several sequences of one body, one after another: what is usual for it is remembered."""

    def __init__(self, schema: BodySchema, rate: float, config: TrustConfig | None = None) -> None:
        """Prepare; the arguments and errors are those of `inspect`."""
        check_schema(schema)
        if not rate > 0.0:
            raise SchemaError(f"rate is {rate:g} Hz; it must be positive: the number of samples per second.")
        if Relations.of(schema) is None:
            raise NotEnoughData(
                "What is normal for this model is not known, so no sensor can be judged. Train it with more samples, "
                "or let it learn what is normal (`gemuco query ROBOT normal`)."
            )
        self._schema, self._rate, self._block = schema, rate, max(1, round(rate * BLOCK))
        self._monitor, self._now = TrustMonitor(schema, config, replaces=self._replaces), 0.0
        self._row = np.zeros(schema.layout.size)

    def inspect(self, samples: Mapping[str, np.ndarray], schema: BodySchema | None = None) -> Inspection:
        """Find lies in the next sequence.

        Args:
            samples: As in `inspect`.
            schema: The same model with another p, if the body has another tool than in the sequence before.
        """
        schema = self._schema = schema or self._schema
        self._monitor.use(schema)
        rows = schema.layout.join(samples)
        if rows.ndim != 2:
            raise WrongSize(
                "One sample cannot be inspected; give all of them, an array of shape (samples, n) per signal."
            )
        followed: list[_Open] = []
        for begin in range(0, len(rows), self._block):
            block = rows[begin : begin + self._block]
            self._row, self._now = block[-1], self._now + BLOCK
            self._monitor.add(schema.scaler.normalise(block), self._now)
            self._follow(followed, begin, begin + len(block))
        matters = sorted((one for one in followed if one.matters), key=lambda one: one.start)
        hidden = np.zeros(rows.shape, bool)
        for one in matters:
            if one.was_hidden:
                hidden[one.start : one.end, list(one.finding.elements)] = True
        lies = tuple(self._lie(schema, one) for one in matters)
        return Inspection(lies, schema.layout.split(hidden), *_repaired(schema, rows, hidden))

    def _follow(self, followed: list[_Open], begin: int, end: int) -> None:
        """Add the findings after the block of the samples from `begin` until before `end`."""
        for finding in self._monitor.findings:
            ago = round((self._now - finding.since) / BLOCK)
            start = max(0, begin - ago * self._block)
            known = next((one for one in reversed(followed) if one.end >= begin and one.is_same(finding)), None)
            if known is None:
                known = _Open(finding, start, end)
                followed.append(known)
            if finding.is_distrusted or not known.was_hidden:
                known.finding, known.start = finding, min(known.start, start)
            known.end, known.seen, known.was_hidden = end, known.seen + 1, known.was_hidden or finding.is_distrusted
        for one in followed:
            if one.was_hidden and one.end == begin:  # it was used again: it has agreed for the whole window
                one.end = max(one.start + self._block, begin - (LONGEST - 1) * self._block)

    def _lie(self, schema: BodySchema, one: _Open) -> Lie:
        finding = one.finding
        names = tuple(schema.layout.element(index) for index in finding.elements)
        return Lie(
            names, finding.cause, finding.kind, one.start / self._rate, one.end / self._rate, finding.size,
            one.was_hidden, "" if one.was_hidden else finding.reason,
        )  # fmt: skip

    def _replaces(self, elements: frozenset[int]) -> bool:
        """Whether the model can estimate some elements while all others are as in the newest sample."""
        finite = np.isfinite(self._row)
        finite[list(elements)] = False
        return bool(self._schema.derived(tried_recipes)(finite).estimated[list(elements)].all())


def _repaired(
    schema: BodySchema, rows: np.ndarray, hidden: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return `Inspection.values` and `Inspection.std` of samples [unit], shape (samples, size)."""
    values, std, wrong = rows.copy(), np.zeros(rows.shape), hidden.any(axis=1)
    if wrong.any():
        estimates = estimate(schema, schema.layout.split(np.where(hidden, np.nan, rows)[wrong]))
        for result, part in ((values, "value"), (std, "std")):
            whole = schema.layout.join({name: getattr(one, part) for name, one in estimates.items()})
            result[wrong] = np.where(hidden[wrong], whole, result[wrong])
    return schema.layout.split(values), schema.layout.split(std)
