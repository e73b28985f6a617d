import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.clock import ManualClock
from services.lateness import GROWTH, RESOLUTION, Lateness
from services.loop import Grid, Loop


def test_grid_stays_on_multiples_of_the_period() -> None:
    grid = Grid(0.005, 100.0)
    assert [round(grid.next(100.0 + 0.005 * k), 9) for k in range(3)] == [100.005, 100.010, 100.015]
    assert grid.skipped == 0


def test_grid_runs_a_late_tick_at_once_and_returns_to_the_grid() -> None:
    grid = Grid(1.0, 0.0)
    grid.next(0.0)
    assert grid.next(2.3) == 2.0
    assert grid.next(2.4) == 3.0
    assert grid.skipped == 0


def test_grid_skips_what_was_slept_through() -> None:
    grid = Grid(1.0, 0.0)
    grid.next(0.0)
    assert grid.next(7.5) == 7.0
    assert grid.skipped == 5
    assert grid.next(7.6) == 8.0


@given(st.lists(st.floats(0.0, 5.0), min_size=1, max_size=50))
def test_grid_never_makes_a_burst(durations: list[float]) -> None:
    """Ticks and skips together are the periods that went by, whatever the ticks took."""
    grid, now = Grid(1.0, 0.0), 0.0
    for ticks, duration in enumerate(durations, 1):
        deadline = grid.next(now)
        assert deadline > now - 1.0 - 1e-9
        assert deadline == pytest.approx(ticks + grid.skipped)
        now = max(now, deadline) + duration


@given(st.lists(st.floats(RESOLUTION, 100.0), min_size=1, max_size=300))
def test_quantiles_since_start_are_exact_to_one_bin(values: list[float]) -> None:
    lateness = Lateness(10)
    for value in values:
        lateness.add(value)
    total = lateness.total()
    assert total["total_max"] == max(values)
    for name, share in (("total_p50", 0.5), ("total_p99", 0.99)):
        exact = float(np.quantile(values, share, method="inverted_cdf"))
        assert exact / GROWTH**1.01 <= total[name] <= exact * GROWTH**1.01


def test_recent_quantiles_forget() -> None:
    lateness = Lateness(100)
    for late in (9.0, *[0.001] * 100):
        lateness.add(late)
    assert lateness.recent() == pytest.approx({"late_p50": 0.001, "late_p99": 0.001, "late_max": 0.001})
    assert lateness.total()["total_max"] == 9.0


def test_lateness_before_the_first_tick_is_zero() -> None:
    assert set(Lateness(1).recent().values()) | set(Lateness(1).total().values()) == {0.0}


class Turns:
    """Counts ticks, and lets a test wait for them."""

    def __init__(self, clock: ManualClock) -> None:
        self.at: list[float] = []
        self.longer = 0.0
        self.raises = False
        self._clock = clock
        self._done = threading.Semaphore(0)

    def __call__(self) -> None:
        self.at.append(self._clock.monotonic())
        self._clock.advance(self.longer)
        self._done.release()
        if self.raises:
            raise RuntimeError("broken on purpose")

    def wait(self) -> None:
        assert self._done.acquire(timeout=10.0)


def _advance_until_tick(clock: ManualClock, turns: Turns) -> None:
    clock.advance(0.1)
    turns.wait()


def test_loop_counts_late_and_skipped_ticks() -> None:
    clock = ManualClock(0.0)
    turns = Turns(clock)
    loop = Loop("slow", 10.0, turns, clock)
    loop.start()
    while loop._grid is None:
        threading.Event().wait(0.001)
    _advance_until_tick(clock, turns)
    turns.longer = 0.35
    _advance_until_tick(clock, turns)
    turns.wait()  # the tick at 0.5, 0.05 late, after 0.3 and 0.4 were skipped
    turns.longer = 0.0
    turns.wait()
    loop._stop.set()
    clock.advance(0.1)
    loop.stop()
    statistics = loop.statistics()
    assert statistics["skipped"] >= 2
    assert statistics["overruns"] >= 1
    assert statistics["ticks"] == len(turns.at)
    assert statistics["total_max"] >= 0.04


def test_loop_survives_a_tick_that_raises(caplog: pytest.LogCaptureFixture) -> None:
    clock = ManualClock(0.0)
    turns = Turns(clock)
    turns.raises = True
    loop = Loop("broken", 10.0, turns, clock)
    loop.start()
    while loop._grid is None:
        threading.Event().wait(0.001)
    for _ in range(3):
        _advance_until_tick(clock, turns)
    loop._stop.set()
    clock.advance(0.1)
    loop.stop()
    assert loop.failed == 3
    assert loop.error == "RuntimeError: broken on purpose"
    assert len([record for record in caplog.records if "failed" in record.message]) == 1


def test_loop_cannot_be_started_twice_and_stops_before_its_start() -> None:
    loop = Loop("idle", 1000.0, lambda: None)
    loop.stop()
    loop.start()
    with pytest.raises(RuntimeError, match="already started"):
        loop.start()
    loop.stop()
    assert loop.statistics()["ticks"] == 0
