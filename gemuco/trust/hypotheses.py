"""The cause of an alarm: the smallest set of columns without which the others agree again."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from gemuco.trust.config import Hidden
from gemuco.trust.evidence import Evidence
from gemuco.trust.jumps import TOGETHER

TOOL, EXPLAINED = 0.85, 0.6
"""Without the wrong columns the evidence against all others is below the second share of an alarm; a contact of the
body changes what is measured by many sensors, and more is left of it. Another tool, what jumped or is stuck, and what
a part measures that may itself have changed are believed below the first."""
CANDIDATES = 5
"""This many columns with the most evidence are held against each other."""
BEHIND = 0.5
"""If none of them explains it, all others with at least this share of the largest evidence are tried."""
SEARCHED = 6
"""Partners are searched for this many columns with the most evidence."""
PLAUSIBLE = 0.4
"""A column is a candidate from this share of an alarm on."""
CONTRADICTED = 0.8
"""All sensors of a part are contradicted if the evidence against each is at least this share of an alarm."""
ALIKE = 6.0
"""Two columns look alike if their logarithms of the likelihood ratio differ by less than this."""
CLOSE = 0.8
"""Nor if the smaller is more than this share of the larger."""
MOST = 3
"""At most this number of columns is named as alternatives."""
AGREES = 0.6
"""Another trained p, or two elements exchanged, explain an alarm if the evidence that is left is below this share of
one."""
RIVALS = 0.1
"""And p if no single element explains it better by more than this share of an alarm."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Columns that explain an alarm.

    Attributes:
        columns: The columns.
        cause: As in `Finding`.
        lead: The column with the most evidence.
        condition: The trained condition whose p explains the alarm; empty if none does.
        is_exchange: Whether they are two elements that agree with all others in each other's place.
        is_contested: Whether a part of the body with several sensors may have changed instead: without all of these the
            alarm would be gone as well.
    """

    columns: Hidden
    cause: str
    lead: int
    condition: str = ""
    is_exchange: bool = False
    is_contested: bool = False

    @property
    def is_element(self) -> bool:
        """Whether it is one element, or one of some that look alike."""
        return self.cause in ("element", "either")


@dataclass(frozen=True, slots=True)
class Signs:
    """Signs of a lie other than a contradiction.

    Attributes:
        sudden: Columns that jumped when the alarm began, while all others moved as usual, or that are stuck.
        first: Columns that jumped alone in the first block of the alarm that lasts. What jumps after it, or contradicts
            the others more, may only follow: an arm falls when a wire is cut.
        jumped: All columns that jumped when the alarm began. What did not jump contradicts them from then on, but has
            not begun to lie.
        held: The column that holds its value while all others move, if one does.
        alone: The column that moved while all others rested, if one did. If one of these is its twin, that may be
            frozen as well.
        beyond: Columns outside of what was learned. There the relations are not known, so if one of them explains the
            alarm, it contradicts no other: the tension of a cut wire makes a right encoder look wrong.
        begun: Columns of parts of which another sensor is hidden already.
    """

    sudden: Hidden = frozenset()
    first: Hidden = frozenset()
    jumped: Hidden = frozenset()
    held: Hidden = frozenset()
    alone: Hidden = frozenset()
    beyond: Hidden = frozenset()
    begun: Hidden = frozenset()


NONE = Signs()
"""Nothing else is known of any column."""


def explain(
    evidence: Evidence,
    without: Callable[[Hidden], Evidence],
    devices: Sequence[Hidden],
    parts: Sequence[Hidden],
    environment: Hidden,
    signs: Signs = NONE,
    conditions: Callable[[], Iterable[tuple[str, Evidence, bool]]] = lambda: (),
    exchanges: Iterable[tuple[Hidden, Evidence]] = (),
    are_twins: Callable[[int, int], bool] = lambda first, second: False,
) -> Cause:
    """Return the most likely cause of an alarm.

    Args:
        evidence: The evidence while nothing more is hidden.
        without: Returns the evidence with more columns hidden.
        devices: Columns that one device measures.
        parts: Columns that belong to one part of the body, such as a muscle, which may itself have changed.
        environment: The columns of p.
        signs: What else is known of the columns.
        conditions: Returns each other trained condition, the evidence under its p, and whether the healthy errors
            under it are known; if not, a doubt is in favour of the sensors.
        exchanges: Pairs of elements, and the evidence if they are exchanged back.
        are_twins: Returns whether hardly anything but each other predicts two columns.
    """
    order = np.argsort(-evidence.strength)
    lead = int(order[0])
    singles, others = _candidates(evidence, environment, signs)
    accused = [part for part in parts if part.intersection(order[:3].tolist())]
    likely = signs.sudden | signs.first | _of_changed_parts(evidence, accused, signs.beyond)
    known: dict[Hidden, float] = {}

    def left(columns: Hidden) -> float:
        """Return the largest evidence without some columns."""
        if columns not in known:
            known[columns] = float(without(columns).ratio.max(initial=0.0))
        return known[columns]

    def solves(columns: Hidden) -> bool:
        return left(columns) < (TOOL if columns <= likely else EXPLAINED)

    def partners() -> Iterator[Hidden]:
        """Yield pairs of columns that hide each other: without the first the second stands out."""
        for column in order[:SEARCHED].tolist():
            if column not in environment and not signs.jumped and not solves(frozenset({column})):
                yield frozenset({column, int(without(frozenset({column})).strength.argmax())})

    single = [c for c in singles if solves(frozenset({c}))] or [c for c in others if solves(frozenset({c}))]
    twins = partial(_twins, without, are_twins)
    sudden = signs.sudden | frozenset(column for column in signs.alone if not twins(column, single))
    part = _changed_part(evidence, without, left, single, accused, signs.begun)
    for preferred in (signs.first, sudden, signs.held, part):
        single = [column for column in single if column in preferred] or single
    possible = single
    single = _beyond_first(single, signs.beyond, left, accused)
    rest = min((left(frozenset({column})) for column in single), default=1.0)
    pair: Hidden = frozenset() if evidence.is_noise.any() else _exchanged(evidence, exchanges, rest, sudden)
    if pair and (not signs.jumped or pair <= signs.jumped):
        return Cause(pair, "all", max(pair, key=lambda c: evidence.strength[c]), is_exchange=True)
    if environment and not evidence.is_slow[lead]:  # another tool is there at once
        tool = _another_tool(evidence, left, environment, conditions, single, rest, sudden | signs.held)
        if tool is not None:
            return tool
    if len(sudden) > 1 and not any(sudden <= part for part in parts) and solves(sudden):
        return Cause(sudden, "all", max(sudden, key=lambda c: evidence.strength[c]))
    if part and not (part | sudden).intersection(single):
        return Cause(part, "part", max(part, key=lambda c: evidence.strength[c]))
    if single:
        alike = [c for c in single if _is_alike(*evidence.strength[[single[0], c]].tolist())]
        alike = list(dict.fromkeys([*alike, *twins(alike[0], possible)]))[:MOST]
        return _named(alike, left, accused)
    for columns, cause in _sets(singles, devices, parts, partners, signs.jumped):
        if solves(columns):
            return Cause(columns, cause, max(columns, key=lambda c: evidence.strength[c]))
    return Cause(frozenset(), "body", lead)


def _named(alike: Sequence[int], left: Callable[[Hidden], float], accused: Sequence[Hidden]) -> Cause:
    """Return the elements that explain an alarm, the most likely first, as its cause."""
    others = [part for part in accused if len(part) > 1 and not part.intersection(alike)]
    is_contested = any(left(part) < TOOL for part in others)
    return Cause(frozenset(alike), "element" if len(alike) == 1 else "either", alike[0], is_contested=is_contested)


def _of_changed_parts(evidence: Evidence, accused: Sequence[Hidden], beyond: Hidden) -> Hidden:
    """Return the columns of accused parts that may themselves have changed: a wire that was cut.

    All sensors of such a part are contradicted, or one has left what was learned.
    """
    whole = [part for part in accused if len(part) > 1 and float(evidence.ratio[list(part)].min()) >= CONTRADICTED]
    return frozenset().union(*whole, *(part & beyond for part in accused))


def _beyond_first(
    single: Sequence[int], beyond: Hidden, left: Callable[[Hidden], float], accused: Sequence[Hidden]
) -> list[int]:
    """Return the columns beyond what was learned, or all if none is.

    One of a part that may itself have changed gives way to another one of it that explains the alarm like any element.
    """
    sure = frozenset(column for column in single if left(frozenset({column})) < EXPLAINED)
    rest = [c for c in single if c in sure or not any(c in part and sure & part for part in accused)]
    return [column for column in rest if column in beyond] or rest


def _twins(
    without: Callable[[Hidden], Evidence], are_twins: Callable[[int, int], bool], first: int, columns: Iterable[int]
) -> list[int]:
    """Return the twins of a column that is hardly contradicted without them, nor are they without it."""
    pairs = [(c, ((first, c), (c, first))) for c in columns if c != first and are_twins(first, c)]
    return [c for c, ways in pairs if all(float(without(frozenset({a})).strength[b]) < ALIKE for a, b in ways)]


def _candidates(evidence: Evidence, environment: Hidden, signs: Signs) -> tuple[list[int], list[int]]:
    """Return the columns that are held against each other, and those that are tried if none of them explains it."""
    plain, jumped = signs.sudden | signs.alone | signs.held, signs.jumped
    order = [int(c) for c in np.argsort(-evidence.strength)]
    singles = [c for c in order[:CANDIDATES] if evidence.ratio[c] >= PLAUSIBLE and c not in environment]
    singles += sorted(plain - environment - set(singles))
    if jumped:
        return [c for c in singles if c in (jumped | plain if len(jumped) <= TOGETHER else signs.held)], []
    least = max(PLAUSIBLE, BEHIND * evidence.highest)
    return singles, [c for c in order[CANDIDATES:] if evidence.ratio[c] >= least and c not in environment]


def remaining(parts: Iterable[Hidden], hidden: Hidden, wrong: Hidden) -> tuple[list[Hidden], Hidden]:
    """Return what can be judged of the parts of the body, and the columns of those that have begun to lie.

    A sensor that is missing, or hidden by an operator, says nothing of the other one of its part.

    Args:
        parts: Columns of each part.
        hidden: Columns that are hidden or missing.
        wrong: Those of them that were hidden because the others contradict them.
    """
    begun: Hidden = frozenset().union(*(part - hidden for part in parts if part & wrong))
    rests = [part - hidden for part in parts]
    return [rest for rest in rests if len(rest) > 1 or (rest and rest <= begun)], begun


def _another_tool(
    evidence: Evidence,
    left: Callable[[Hidden], float],
    environment: Hidden,
    conditions: Callable[[], Iterable[tuple[str, Evidence, bool]]],
    single: Sequence[int],
    rest: float,
    sudden: Hidden,
) -> Cause | None:
    """Return another tool or load as the cause; None if none explains the alarm as well as the elements.

    Args:
        evidence: The evidence.
        left: Returns the largest evidence without some columns.
        environment: The columns of p.
        conditions: As in `explain`.
        single: Columns that explain the alarm alone, the most likely first.
        rest: Smallest evidence that is left without one of them.
        sudden: Columns that gave themselves away.
    """
    lead = int(evidence.strength.argmax())
    if not evidence.is_noise[lead]:
        for name, other, is_known in conditions():
            if float(other.ratio.max(initial=0.0)) < (min(AGREES, rest + RIVALS) if is_known else TOOL):
                return Cause(environment, "environment", lead, name)
    if not sudden.intersection(single):  # another tool moves the whole tip
        own = float(evidence.strength[list(environment)].max())
        best = float(evidence.strength[single[0]]) if single else 0.0
        if own >= CLOSE * best - ALIKE and left(environment) < TOOL:
            return Cause(environment, "environment", lead)
    return None


def _changed_part(
    evidence: Evidence,
    without: Callable[[Hidden], Evidence],
    left: Callable[[Hidden], float],
    single: Sequence[int],
    parts: Iterable[Hidden],
    begun: Hidden,
) -> Hidden:
    """Return the part that explains an alarm better than all single elements of others; empty if none does.

    Without it more evidence may be left than without an element: the body has come where nothing was learned.

    Args:
        evidence: The evidence.
        without: Returns the evidence with more columns hidden.
        left: Returns the largest of it.
        single: Columns that explain the alarm alone.
        parts: Parts of the body with several sensors.
        begun: Columns of parts of which another sensor is hidden already; these need to explain it nearly as well.
    """
    for part in parts:
        rivals = [column for column in single if column not in part]
        best = max((float(evidence.strength[c]) for c in rivals), default=0.0)
        least = min((left(frozenset({column})) for column in rivals), default=TOOL)
        is_begun = part <= begun
        if left(part) >= (TOOL if is_begun else least):
            continue
        first = max(part, key=lambda c: evidence.strength[c])
        others = float(without(frozenset({first})).strength[list(part - {first})].sum())
        if evidence.strength[first] + others > (CLOSE * best if is_begun else best + ALIKE):
            return part
    return frozenset()


def _exchanged(evidence: Evidence, exchanges: Iterable[tuple[Hidden, Evidence]], rest: float, sudden: Hidden) -> Hidden:
    """Return the pair that agrees best in each other's place, and better than `rest` or if both jumped; empty if none.

    Noise is not explained by an exchange.
    """
    calmer = [(float(o.ratio.max(initial=0.0)), sorted(p)) for p, o in exchanges if o.level <= evidence.level]
    agreeing = [
        (not sudden.issuperset(p), r, p) for r, p in calmer if r < AGREES and (r < rest or sudden.issuperset(p))
    ]
    return frozenset(min(agreeing)[2]) if agreeing else frozenset()


def _is_alike(best: float, other: float) -> bool:
    return best - other < ALIKE or other > CLOSE * best


def _sets(
    singles: Sequence[int],
    devices: Sequence[Hidden],
    parts: Sequence[Hidden],
    partners: Callable[[], Iterator[Hidden]],
    jumped: Hidden,
) -> Iterator[tuple[Hidden, str]]:
    """Yield the parts and devices that contain one of the first two candidates, and pairs.

    If many jumped, all of them lie or none does: then only devices that measure them all.
    """
    if len(jumped) > TOGETHER:
        yield from ((device, "all") for device in devices if jumped <= device)
        return
    first = set(singles[:2])
    yield from ((part, "part") for part in parts if part & first)
    yield from ((frozenset(pair), "all") for pair in combinations(singles[:3], 2))
    yield from ((pair, "all") for pair in partners() if len(pair) == 2)
    for device in sorted((device for device in devices if device & first and len(device) > 1), key=len):
        yield device, "all"
