"""What the benchmarks have in common: ours and a peer in turn, and rows with a bar."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

Job = Callable[[], object]


@dataclass(frozen=True, slots=True)
class Row:
    """One result.

    Attributes:
        what: Was measured.
        against: The peer.
        ours: Of ours, in `unit`.
        theirs: Of the peer.
        unit: Of both.
        value: What is compared with the bar: how many times better, or what `bar` says.
        bar: What was to be reached; a lower limit unless `is_most`.
        is_most: The bar is an upper limit.
        note: What a reader must know.
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
        """Whether the bar was."""
        return self.value <= self.bar if self.is_most else self.value >= self.bar

    def plain(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


def timed(job: Job, repeats: int) -> float:
    """Time of one call [us], the mean over a batch."""
    begun = time.perf_counter()
    for _ in range(repeats):
        job()
    return 1e6 * (time.perf_counter() - begun) / repeats


def side_by_side(ours: Job, theirs: Job, rounds: int = 7, share: float = 0.03) -> tuple[float, float, float]:
    """Median times [us] of ours and theirs, and the median over rounds of their ratio in the same round.

    Args:
        ours: One call.
        theirs: One call of the peer.
        rounds: How often both are measured, in turn.
        share: Time [s] that a batch of calls should take.
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
    """A row that says how many times as fast ours is."""
    mine, other, ratio = side_by_side(ours, theirs, rounds)
    return Row(what, against, mine, other, "us", ratio, bar, note=note)
