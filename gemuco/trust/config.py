"""Settings of the trust in sensors, and what is found."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

Hidden = frozenset[int]
"""Judged columns that are not used: elements, then p, by their number in `Relations.columns`."""
Replaces = Callable[[frozenset[int]], bool]
"""Whether all elements of a set can be estimated while none of them is measured."""

BLOCK = 0.1
"""Samples are judged in blocks of this length [s]."""


@dataclass(frozen=True, slots=True)
class TrustConfig:
    """Settings that a person can choose.

    Attributes:
        false_alarms: A healthy robot may have this number of wrong verdicts per hour.
        size: A lie matters from this size on [errors of a healthy prediction].
        sizes: The same for single signals; it replaces `size`.
        pairs: What is done with elements that look alike: `hide` all of them, or `use` them all.
    """

    false_alarms: float = 1.0 / 168.0
    size: float = 3.0
    sizes: Mapping[str, float] = field(default_factory=dict)
    pairs: str = "hide"


@dataclass(frozen=True, slots=True)
class Finding:
    """Elements that the others contradict, and the most likely cause.

    Attributes:
        elements: Positions in the layout; empty if the cause is the environment or the whole body.
        cause: `element`; `either` of several that look alike; `all` of them; `part` of the body; `environment` (another
            p); or `body`, if no set of elements explains what is seen.
        kind: `frozen`, `offset`, `wrap`, `drift`, `gain`, `sign`, `clipped`, `swapped`, `noise` or `unknown`.
        since: Time of the first wrong block [s].
        size: Root mean square of measured minus predicted since then [unit of the first element].
        is_distrusted: Whether the elements are hidden; if not, they are suspected and still used.
        by_hand: Whether an operator decided.
        reason: Why they are still used, if a rule forbids to hide them; else empty.
        is_gross: Whether the evidence is much more than an alarm, and all others fit each other; with a tool or load
            that explained all sensors before.
        condition: The trained condition whose p explains what is seen, if the cause is the environment; else empty.
    """

    elements: tuple[int, ...]
    cause: str
    kind: str
    since: float
    size: float = float("nan")
    is_distrusted: bool = False
    by_hand: bool = False
    reason: str = ""
    condition: str = ""
    is_gross: bool = False
