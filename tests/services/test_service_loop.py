import os
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.clock import ManualClock
from services.model.gemuco_service import OFFSETS
from services.process import realtime
from services.process.lateness import GROWTH, RESOLUTION, Lateness
from services.process.loop import Grid, Loop
from services.process.realtime import prepare_thread, promote
from services.process.service import STATUS_AT, STATUS_EVERY, STATUS_STEP, next_status


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


@given(st.floats(0.0, 1e6), st.floats(0.0, 0.02), st.sampled_from([0.002, 0.005, 0.01, 0.05]))
def test_grids_of_one_clock_keep_their_distance(now: float, offset: float, period: float) -> None:
    """Whenever a loop is started, it ticks at the same moments of the clock, the first of them within a period."""
    first = Grid.aligned(period, offset, now).next(now)
    assert now - 1e-6 < first <= now + period + 1e-6
    away = (first - offset) % period
    assert min(away, period - away) < 1e-6


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


class DreamClock(ManualClock):
    """Sleeping on it moves it on, and no real time goes by."""

    def sleep_until(self, deadline: float) -> None:
        self.advance(max(0.0, deadline - self.monotonic()))


def _run(durations: list[float], broken: bool = False) -> tuple[Loop, DreamClock, list[float]]:
    """A loop of 10 Hz that ended after ticks of these durations [s], and when they began."""
    clock = DreamClock(0.0)
    begun: list[float] = []

    def tick() -> None:
        begun.append(clock.monotonic())
        clock.advance(durations[len(begun) - 1])
        if len(begun) == len(durations):
            loop.stop()
        if broken:
            raise RuntimeError("broken on purpose")

    loop = Loop("dream", 10.0, tick, clock)
    loop.start()
    assert loop._thread is not None
    loop._thread.join(10.0)
    loop.stop()
    return loop, clock, begun


def test_loop_counts_overruns_and_skips() -> None:
    loop, _, begun = _run([0.0, 0.35, 0.0, 0.0])
    assert begun == pytest.approx([0.1, 0.2, 0.55, 0.6])
    statistics = loop.statistics()
    assert statistics["skipped"] == 2
    assert statistics["overruns"] == 1
    assert statistics["ticks"] == 4
    assert statistics["total_max"] == statistics["late_max"] == pytest.approx(0.05)
    assert statistics["late_p50"] == pytest.approx(0.0)
    assert statistics["rate"] == pytest.approx(4 / 0.6)
    assert statistics["busy"] == pytest.approx(0.35 / 0.6)


def test_loop_survives_a_tick_that_raises(caplog: pytest.LogCaptureFixture) -> None:
    loop, clock, _ = _run([0.0] * 5, broken=True)
    assert loop.failed == loop.statistics()["ticks"] == 5
    assert loop.error == "RuntimeError: broken on purpose"
    assert len([record for record in caplog.records if "failed" in record.message]) == 1
    clock.advance(60.0)
    assert loop.error == ""


def _scheduling() -> int:
    return os.sched_getscheduler(threading.get_native_id()) & ~os.SCHED_RESET_ON_FORK


@pytest.mark.parametrize("is_slow", [False, True])
def test_a_start_runs_before_normal_programs_and_not_for_long(is_slow: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realtime, "STARTS_WITHIN", 0.05)
    seen: list[int] = []

    def start() -> None:
        with realtime.starting():
            seen.append(_scheduling())
            inner = threading.Thread(target=lambda: seen.append(_scheduling()))
            inner.start()
            inner.join()
            deadline = time.monotonic() + 10.0
            while is_slow and _scheduling() != os.SCHED_OTHER and time.monotonic() < deadline:
                time.sleep(0.01)
            seen.append(_scheduling() if is_slow else os.SCHED_OTHER)
        seen.append(_scheduling())

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    first, inner, after_a_while, afterwards = seen
    assert first in (os.SCHED_FIFO, os.SCHED_OTHER)  # as the system allows
    assert (inner, after_a_while, afterwards) == (os.SCHED_OTHER,) * 3


def test_a_start_without_permission_is_a_start(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(realtime.os, "sched_setscheduler", refuse)
    with realtime.starting():
        assert _scheduling() == os.SCHED_OTHER


class Kernel:
    """A system that allows real-time scheduling, with the priorities that the calling thread asked for."""

    def __init__(self, policy: int, priority: int) -> None:
        self.policy, self.asked = policy | os.SCHED_RESET_ON_FORK, [priority]

    def sched_getscheduler(self, thread: int) -> int:
        return self.policy

    def sched_getparam(self, thread: int) -> os.sched_param:
        return os.sched_param(self.asked[-1])

    def sched_setscheduler(self, thread: int, policy: int, param: os.sched_param) -> None:
        assert (thread, policy) == (0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK)
        self.asked.append(param.sched_priority)


@pytest.mark.parametrize(
    ("policy", "priority", "asked"),
    [(os.SCHED_FIFO, 45, [45, 10, 45]), (os.SCHED_FIFO, 10, [10]), (os.SCHED_OTHER, 0, [0])],
)
def test_long_work_runs_below_the_loops_and_then_as_before(
    policy: int, priority: int, asked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = Kernel(policy, priority)
    for name in ("sched_getscheduler", "sched_getparam", "sched_setscheduler"):
        monkeypatch.setattr(realtime.os, name, getattr(kernel, name))
    inside: list[int] = []
    with pytest.raises(RuntimeError), realtime.at_most(10):
        inside.append(kernel.asked[-1])
        raise RuntimeError("The work failed.")
    assert (inside, kernel.asked) == ([min(priority, 10)], asked)


def test_real_time_is_tried_and_a_refusal_is_no_error() -> None:
    found: list[str] = []
    ready, done = threading.Event(), threading.Event()

    def prepare() -> None:
        found.extend((prepare_thread(0), prepare_thread(1)))
        ready.set()
        done.wait(10.0)

    thread = threading.Thread(target=prepare, name="prepared for the test")
    thread.start()
    assert ready.wait(10.0)
    promote("prepared for", 2)
    done.set()
    thread.join()
    assert found[0] == "other"
    assert found[1] in ("fifo", "other")


def test_loop_cannot_be_started_twice_and_stops_before_its_start() -> None:
    loop = Loop("idle", 1000.0, lambda: None)
    loop.stop()
    loop.start()
    with pytest.raises(RuntimeError, match="already started"):
        loop.start()
    loop.stop()
    assert loop.statistics()["ticks"] == 0


class _Busy:
    """A loop whose ticks take so long [s] of a manual clock, for one second of it."""

    def __init__(self, rate: float, takes: float, delayed: float = 0.0) -> None:
        self.clock = ManualClock()
        self.loop = Loop("busy", rate, lambda: self.clock.advance(takes), self.clock)
        begun = self.clock.monotonic()

        def late(deadline: float) -> None:
            if self.clock.monotonic() - begun > 1.0:
                self.loop.stop()
            self.clock.advance(max(0.0, deadline - self.clock.monotonic()) + delayed)

        self.clock.sleep_until = late  # type: ignore[method-assign]
        self.loop._run()
        self.loop.statistics()


@pytest.mark.parametrize(
    ("takes", "delayed", "said"),
    [
        (0.002, 0.0, ""),
        (0.0095, 0.0, ""),
        (0.025, 0.0, "a tick takes 25 ms, the period is 10 ms"),
        (0.001, 0.018, "of the time. Is this machine busy?"),
    ],
)
def test_a_loop_that_does_not_keep_its_rate_says_why(takes: float, delayed: float, said: str) -> None:
    loop = _Busy(100.0, takes, delayed).loop
    assert said in loop.trouble if said else not loop.trouble
    assert bool(said) == ("of 100 Hz" in loop.trouble) == loop.is_slow


@pytest.mark.parametrize("phase", [0.0001, 0.0013, 0.0026, 0.0048])
@pytest.mark.parametrize("times", [1, 2])
def test_a_loop_that_follows_begins_shortly_after_what_it_works_on_has_come(phase: float, times: int) -> None:
    """Samples of 200 Hz with jitter, and a loop of once or twice the rate that begins anywhere."""
    random = np.random.default_rng(1)
    period = 0.005 / times
    grid, now, waits, taken = Grid(period, 0.0), 0.0, [], 0
    for _ in range(4000 * times):
        now = max(now, grid.next(now))
        arrived = np.floor((now - phase) / 0.005)
        came = phase + 0.005 * arrived + abs(random.normal(0.0, 0.0001))
        if arrived > taken and came <= now:
            taken = arrived
            waits.append(now - came)
            grid.follow(now - came)
    late = np.array(waits[-1000:])
    assert np.median(late) < 0.3 * period
    assert (late < 0.5 * period).mean() > 0.95
    assert grid.skipped == 0


@given(st.floats(0.0, 1e6))
def test_statuses_come_a_period_apart_at_moments_that_are_theirs(now: float) -> None:
    due = next_status(now)
    assert abs(due - now - STATUS_EVERY) <= 0.5 * STATUS_STEP + 1e-6
    assert abs((due - STATUS_AT + 0.5 * STATUS_STEP) % STATUS_STEP - 0.5 * STATUS_STEP) < 1e-6
    assert next_status(due + 0.002) == pytest.approx(due + STATUS_EVERY)


@pytest.mark.parametrize(
    ("name", "rate"),
    [("estimation", 500.0), ("estimation", 200.0), ("anomaly", 200.0), ("control", 100.0), ("update", 20.0)],
)
def test_a_status_has_a_millisecond_until_the_next_tick_begins(name: str, rate: float) -> None:
    until_next = (OFFSETS[name] - STATUS_AT) % (1.0 / rate)
    assert until_next > 0.001
