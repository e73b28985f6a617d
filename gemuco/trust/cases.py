"""Suspected and hidden causes, and what kind of lie each of them is."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gemuco.schema import BodySchema
from gemuco.trust.changes import LONGEST
from gemuco.trust.config import Finding, Hidden
from gemuco.trust.evidence import Evidence
from gemuco.trust.hypotheses import Cause
from gemuco.trust.recent import Recent, View
from gemuco.trust.relations import Relations

CLEAR = 2.0
"""A lie begins with the first error of this size [errors of a healthy prediction]."""
SURE = 2.0
"""Another cause replaces one if its evidence is this multiple."""
LAPSES = 10
"""A suspicion ends if nothing speaks for it in this number of blocks."""
YOUNG = 100
"""What is seen within this number of blocks after an element was hidden may show that it was another one."""
SAME = 0.3
"""An error and a jump are the same if they differ by less than this share of the jump."""
AGREED = 20
"""Elements agree again if they do in all of the newest `LONGEST` blocks in which they are known, at least this many:
on a machine that stalls samples are missing now and then."""
MOVES = 3.0
"""Before a frozen element returns, it and its prediction move by this much [errors of a healthy prediction]."""
TURN = 2.0 * np.pi
STILL = 0.1
"""A frozen value moves by less than this [errors of a healthy prediction]."""
WENT = 1.5
"""Meanwhile its prediction moves by at least this."""
CONSTANT = 0.35
"""The error of an offset varies by less than this share of it."""
BETTER = 0.5
"""A kind with one more number must leave less than this share of the squared error."""
PATIENCE = 100
"""An element that jumped away returns after this number of blocks, or after it has jumped back."""
SHOWN = 5.0
"""Where a part of the body may have changed instead, an element is hidden after this number of blocks of motion: one
posture shows both alike."""


@dataclass(slots=True)
class Case:
    """A cause under suspicion, or hidden.

    Attributes:
        cause: The cause.
        began: Number of the first wrong block.
        first: Number of the block in which it was suspected first.
        last: Number of the newest block that speaks for it.
        seen: Number of blocks that were explained by it.
        weight: Their evidence, the sum of squared shares of an alarm.
        steps: Their largest results of the step test [standard deviations], shape (columns,).
        moved: Motion in these blocks, and in all since it is hidden [blocks at the usual pace].
        is_hidden: Whether its elements are hidden.
        has_jumped: Whether an element has jumped away, and not yet back.
        jumped_alone: Whether it is one element that is wrong by as much as it jumped, so the body did not move with it.
        is_plain: Whether an element jumped or was stuck, so that it certainly lied.
        is_gross: Whether it is much more than an alarm, and all others fit each other.
        may_be_body: Whether the part of the body that its sensors measure may have changed, so that they are right: a
            wire that is cut contradicts the sensors of its neighbours too.
        kind: As in `Finding`.
        size: As in `Finding`.
        reason: Why its elements are still used, if a rule forbids to hide them.
    """

    cause: Cause
    began: int
    first: int
    last: int
    seen: int = 1
    weight: float = 0.0
    steps: np.ndarray = field(default_factory=lambda: np.zeros(1))
    moved: float = 0.0
    is_hidden: bool = False
    has_jumped: bool = False
    jumped_alone: bool = False
    is_gross: bool = False
    is_plain: bool = False
    may_be_body: bool = False
    kind: str = "unknown"
    size: float = math.nan
    reason: str = ""

    def weigh(self, evidence: Evidence, sudden: Hidden, stuck: Hidden, parts: Iterable[Hidden]) -> None:
        """Add the evidence of one block, in which some columns had jumped lately or were stuck.

        Args:
            evidence: The evidence.
            sudden: Columns that had jumped.
            stuck: Columns that were stuck.
            parts: Columns of each part of the body with several sensors.
        """
        columns, is_noise = self.cause.columns, bool(evidence.is_noise[self.cause.lead])
        has_jumped, is_stuck = bool(columns & sudden), bool(columns & stuck)
        self.has_jumped |= has_jumped
        self.is_plain |= has_jumped or is_stuck
        is_sensor = self.cause.is_exchange or is_noise or is_stuck
        strongest = frozenset(np.argsort(-evidence.strength)[:2].tolist())
        is_body = self.cause.cause == "part" or any(columns | strongest <= part for part in parts)
        self.may_be_body |= is_body and not is_sensor
        self.weight += float(evidence.ratio.max()) ** 2
        self.steps = np.fmax(self.steps, evidence.step)

    def has_shown(self, cause: Cause) -> bool:
        """Whether the body moved enough to know an element from a part of the body that may have changed instead."""
        return self.moved >= SHOWN or not cause.is_contested

    def waits(self, now: int) -> bool:
        """Whether it is too early to use it again, although it agrees.

        Exchanged elements seem to agree where the two cross; one that jumped away has not jumped back.
        """
        exchanged, jumped = LONGEST * self.cause.is_exchange, PATIENCE * self.has_jumped
        return now - self.first < max(exchanged, jumped)

    def has_lapsed(self, now: int, highest: float) -> bool:
        """Whether nothing speaks for a suspicion any more; `highest` is the evidence against any element."""
        if highest >= 1.0 and self.cause.cause == "body":
            self.last = now
        return now - self.last > LAPSES

    def is_young(self, now: int, least: int = 0) -> bool:
        """Whether it is an element that was hidden not long ago, `least` blocks or more, and did not certainly lie."""
        is_sure = self.is_plain or not self.cause.is_element
        return self.is_hidden and not is_sure and least <= now - self.first < YOUNG

    def changes(self, columns: Hidden, parts: Iterable[Hidden]) -> bool:
        """Whether the body may be another one for some columns; a part that has changed is so for all others."""
        is_body = self.may_be_body and not any(self.cause.columns | columns <= part for part in parts)
        return is_body or self.cause.cause == "environment"

    def crosses(self, parts: Iterable[Hidden], devices: Iterable[Hidden], sure: Hidden) -> bool:
        """Whether it is several elements of a body whose parts can change, and not of one part or device.

        A cut wire contradicts its neighbours too, which is likelier than two sensors that begin to lie at once.

        Args:
            parts: Columns of each part of the body with several sensors.
            devices: Columns that one device measures.
            sure: Columns that jumped lately or are stuck.
        """
        columns = self.cause.columns
        is_one = any(columns <= whole for whole in (*parts, *devices, sure))
        is_several = self.cause.cause == "all" and not self.cause.is_exchange
        return is_several and not is_one and any(columns & part for part in parts)

    def is_bound(self, again: Cause, parts: Iterable[Hidden], beyond: Hidden) -> bool:
        """Whether an element of another part of the body must not replace it.

        So it is if one of the sensors of its part jumped, or is beyond what was learned, or all are contradicted: a cut
        wire lets the arm go where its neighbours look wrong. Nor may one of some that look alike replace all of them
        while another one is beyond.

        Args:
            again: The element that explains best what is seen now.
            parts: Columns of each part of the body with several sensors.
            beyond: Columns outside of what was learned.
        """
        whole, own = self._whole(parts), self.cause.columns & beyond
        if again.columns < self.cause.columns:
            return not again.columns & own and any(own & part for part in parts)
        return not again.columns <= whole and (self.is_plain or self.may_be_body or bool(whole & beyond))

    def _whole(self, parts: Iterable[Hidden]) -> Hidden:
        """Return all columns of its part of the body."""
        columns = self.cause.columns
        return columns.union(*(part for part in parts if columns <= part))

    def yields_to(self, again: Cause, evidence: Evidence, parts: Iterable[Hidden], beyond: Hidden) -> bool:
        """Whether another element replaces it: one of those that look alike, or one with much more evidence.

        It is held against all sensors of its part of the body.

        Args:
            again: The element that explains best what is seen now.
            evidence: The evidence now.
            parts: As in `is_bound`.
            beyond: As in `is_bound`.
        """
        if again.columns == self.cause.columns or self.is_bound(again, parts, beyond):
            return False
        own = float(evidence.strength[list(self._whole(parts) - again.columns)].max())
        return float(evidence.strength[again.lead]) > (1.0 if again.columns < self.cause.columns else SURE) * own

    def finding(self, elements: Sequence[int], since: float, has_explained: bool) -> Finding:
        """Return what others see of it.

        Args:
            elements: Positions of its elements in the layout.
            since: They are wrong since this time [s].
            has_explained: Whether the tool or load that is judged by has explained all sensors before; if not, it is
                likelier wrong than a sensor.
        """
        return Finding(
            tuple(elements), self.cause.cause, self.kind, since, self.size, self.is_hidden,
            reason=self.reason, condition=self.cause.condition, is_gross=self.is_gross and has_explained,
        )  # fmt: skip


@dataclass(slots=True)
class LastSearch:
    """The last search for a cause, which costs as much as 50 blocks.

    Attributes:
        alarming: The columns that had the evidence of an alarm.
    """

    alarming: Hidden = frozenset()

    def answer(self, cases: Iterable[Case], ratio: np.ndarray, is_due: bool) -> Case | None:
        """Return the case that answers for this block too; None if there is no alarm, or a search is to be made.

        The last search answers if it found no cause at all, or one that cannot be hidden and no other column alarms.

        Args:
            cases: All cases.
            ratio: Evidence against each column [multiples of an alarm], shape (columns,).
            is_due: Whether it is time for another search in any case.
        """
        alarming = frozenset(np.flatnonzero(ratio >= 1.0).tolist())
        if not alarming:
            return None
        case = next((c for c in cases if not c.is_hidden and (c.cause.cause == "body" or c.reason)), None)
        if case is None or is_due or not (case.cause.cause == "body" or alarming <= self.alarming):
            self.alarming = alarming
            return None
        return case


def describe(
    case: Case, view: View, recent: Recent, relations: Relations, schema: BodySchema, scale: np.ndarray, now: int,
    is_noise: bool,
) -> None:  # fmt: skip
    """Find kind and size of a lie from its blocks so far.

    Args:
        case: The case; its kind, size and first wrong block are set.
        view: Errors predicted from trusted elements only.
        recent: The newest blocks.
        relations: The relations.
        schema: The model.
        scale: Errors on this body [unit of the view], shape (columns,).
        now: Number of the newest block.
        is_noise: Whether its noise is the strongest evidence.
    """
    columns = [column for column in sorted(case.cause.columns) if column < relations.count]
    if not columns:  # p alone
        return
    count = min(max(1, now - case.began + 1), len(recent.blocks), LONGEST)
    lead = case.cause.lead if case.cause.lead in columns else columns[0]
    values, spans = recent.values()[-count:], recent.spans()[-count:]
    error = view.z[-count:] * view.healthy[-count:]
    known = np.isfinite(error[:, columns]).all(axis=1)
    if not known.any():
        return
    values, error, spans = values[known], error[known], spans[known]
    healthy = view.healthy[-count:][known][:, lead]
    clear = np.abs(error[:, lead]) > CLEAR * healthy * scale[lead]
    if not is_noise and clear.any() and not case.is_hidden:
        first = int(np.argmax(clear))
        values, error, spans, healthy = values[first:], error[first:], spans[first:], healthy[first:]
        case.began = now - len(values) + 1
    position = int(relations.columns[lead])
    std, layout = float(schema.scaler.std[position]), schema.layout
    unit = layout.signal(layout.element(position).partition(".")[0]).unit
    others = [c for c in columns if c != lead and relations.signals[c] == relations.signals[lead]]
    if case.has_jumped and len(before := recent.values()[: -len(values) - 1]):
        jump = values[-1, lead] - before[-1, lead]
        case.jumped_alone = case.cause.cause == "element" and bool(abs(error[-1, lead] - jump) < SAME * abs(jump))
    case.kind = "swapped" if case.cause.is_exchange else kind_of(
        values[:, lead], error[:, lead], float(healthy.mean()), std, unit, is_noise,
        values[:, others] - error[:, others] if case.cause.cause == "all" else None, float(spans[:, lead].max()),
        case.has_jumped,
    )  # fmt: skip
    case.size = float(np.sqrt(np.mean(error[:, lead] ** 2))) * std


def has_agreed(errors: np.ndarray, least: np.ndarray) -> bool:
    """Whether elements agree again with all others.

    Args:
        errors: Their errors in the newest blocks [standard deviations of this body], shape (LONGEST, n), NaN where
            unknown.
        least: Errors that matter, in the same unit, shape (n,).
    """
    known = np.abs(errors[np.isfinite(errors).all(axis=1)])
    return len(known) >= AGREED and bool(known.max() < least.max())


def has_moved(case: Case, shown: View, recent: Recent) -> bool:
    """Whether an element that was frozen has moved with its prediction."""
    if case.kind not in ("frozen", "clipped"):
        return True
    values = recent.values()[-LONGEST:]
    healthy, way = shown.healthy[-len(values) :], np.fmax.reduce(values) - np.fmin.reduce(values)
    return all(way[c] > MOVES * np.nanmean(healthy[:, c]) for c in case.cause.columns)


def kind_of(
    value: np.ndarray, error: np.ndarray, healthy: float, std: float, unit: str, is_noise: bool,
    others: np.ndarray | None = None, span: float = np.inf, has_jumped: bool = False,
) -> str:  # fmt: skip
    """Return the kind of a lie; `unknown` of fewer than three blocks that no simple kind fits.

    Args:
        value: Measured since it began [standard deviations of the signal], shape (blocks,).
        error: Measured minus predicted from trusted elements only, shape (blocks,).
        healthy: Error of a healthy prediction [standard deviations].
        std: Standard deviation of the signal [unit].
        unit: Unit of the element.
        is_noise: Whether its noise is the strongest evidence.
        others: Predictions of other elements of the signal that are wrong too [unit of `value`], shape (blocks, n).
        span: Largest range of the value within a block [standard deviations].
        has_jumped: Whether it began with a jump; then a constant value of a body at rest is not frozen.
    """
    if is_noise:
        return "noise"
    predicted = value - error
    if others is not None and others.size and len(value) >= 3:
        miss = np.abs(value[:, None] - others).mean(axis=0).min()
        if miss < BETTER * np.abs(error).mean():
            return "swapped"
    if len(value) >= 2 and max(np.ptp(value), min(span, np.inf)) < STILL * healthy:
        if np.ptp(predicted) > WENT * healthy:
            outer = np.abs(predicted).min() >= abs(value.mean()) and np.all(predicted * value.mean() > 0)
            return "clipped" if outer else "frozen"
        if len(value) >= 3 and not has_jumped:
            return "frozen"
    mean = float(np.median(error))
    turns = mean * std / TURN
    if unit == "rad" and abs(round(turns)) >= 1 and abs(turns - round(turns)) * TURN < max(3.0 * healthy * std, 0.05):
        return "wrap"
    if len(value) < 5 or np.std(error) < CONSTANT * abs(mean):
        return "offset"
    return _fitted(predicted, error, healthy)


def _fitted(predicted: np.ndarray, error: np.ndarray, healthy: float) -> str:
    """Return the kind whose line fits the error: constant, growing with time, or with the value."""
    left = float(np.sum((error - error.mean()) ** 2))
    time = np.arange(len(error)) - (len(error) - 1) / 2.0
    constant = max(left, len(error) * (0.5 * healthy) ** 2)
    by_time = left - float(time @ error) ** 2 / float(time @ time)
    kinds = {"drift": by_time}
    spread = predicted - predicted.mean()
    if np.std(predicted) > 2.0 * healthy:
        slope = float(spread @ error) / float(spread @ spread)
        by_value = left - slope**2 * float(spread @ spread)
        kinds["sign" if -2.5 < slope < -1.5 else "gain"] = by_value
    best = min(kinds, key=lambda kind: kinds[kind])
    return best if kinds[best] < BETTER * constant else "offset"
