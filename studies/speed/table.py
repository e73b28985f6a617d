"""Measurements of gemuco and a peer in alternation; rows of a table with a bar."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

Job = Callable[[], object]


@dataclass(frozen=True, slots=True)
class Row:
    """One result.

    Attributes:
        what: The measured quantity.
        against: The peer.
        ours: Result of gemuco, in `unit`.
        theirs: Result of the peer, in `unit`.
        unit: Unit of `ours` and `theirs`.
        value: Number that is compared with the bar: a ratio, or the quantity that `what` names.
        bar: Limit to reach: a lower limit unless `is_most`; 0 without a limit.
        is_most: The bar is an upper limit.
        note: Remark that is printed below the table.
    """

    what: str
    against: str
    ours: float
    theirs: float
    unit: str
    value: float
    bar: float
    is_most: bool = False
    note: str = ""

    @property
    def is_reached(self) -> bool:
        """Whether the value is on the right side of the bar."""
        return self.value <= self.bar if self.is_most else self.value >= self.bar

    def cells(self) -> list[str]:
        """Return the row's cells in the order of docs/benchmarks.md."""
        mark = "" if not self.bar else "yes" if self.is_reached else "NO"
        sign = "at most " if self.is_most else ""
        value = f"{self.value:.3g}" + ("" if self.is_most else " x")
        bar = f"{sign}{self.bar:g}" + ("" if self.is_most else " x") if self.bar else "-"
        numbers = (f"{number:.3g} {self.unit}" for number in (self.ours, self.theirs))
        return [self.what, self.against, *numbers, value, bar, mark]


def show(rows: Iterable[Row]) -> None:
    """Print rows as they are measured."""
    for row in rows:
        print(" | ".join([*row.cells(), row.note]), flush=True)


def timed(job: Job, repeats: int) -> float:
    """Return the time of one call [us], the mean over a batch."""
    begun = time.perf_counter()
    for _ in range(repeats):
        job()
    return 1e6 * (time.perf_counter() - begun) / repeats


def side_by_side(ours: Job, theirs: Job, rounds: int = 7, share: float = 0.03) -> tuple[float, float, float]:
    """Return the median times [us] of gemuco and the peer, and the median of the ratios within each round.

    Args:
        ours: One call of gemuco.
        theirs: One call of the peer.
        rounds: Number of rounds; each measures one batch of gemuco and one batch of the peer.
        share: Time [s] of one batch of calls.
    """
    counts = []
    for job in (ours, theirs):
        job()
        begun = time.perf_counter()
        job()
        counts.append(max(1, round(share / max(time.perf_counter() - begun, 1e-7))))
    times = np.array([[timed(job, count) for job, count in zip((ours, theirs), counts, strict=True)]
                      for _ in range(rounds)])  # fmt: skip
    return float(np.median(times[:, 0])), float(np.median(times[:, 1])), float(np.median(times[:, 1] / times[:, 0]))


def faster(what: str, against: str, ours: Job, theirs: Job, bar: float, note: str = "", rounds: int = 7) -> Row:
    """Return a row whose value is the peer's time divided by that of gemuco."""
    mine, other, ratio = side_by_side(ours, theirs, rounds)
    return Row(what, against, mine, other, "us", ratio, bar, note=note)
