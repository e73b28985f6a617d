import os
import threading
from collections.abc import Iterator

import pytest

from services.process.one_core import CROWDED, FULL, PATIENCE, OneCore, busy

ALLOWED = sorted(os.sched_getaffinity(0))
pytestmark = pytest.mark.skipif(len(ALLOWED) < 2, reason="One core is all that there is.")


class Machine:
    """Cores that others use so much, and a process that works so much of the time."""

    def __init__(self) -> None:
        self.now, self.mine = 0.0, 0.0
        self.worked = dict.fromkeys(ALLOWED, 0.0)
        self.core = OneCore(lambda: dict(self.worked), lambda: self.mine, lambda: self.now)

    def second(self, own: float = 0.2, is_slow: bool = False, others: dict[int, float] | None = None) -> int | None:
        """Let a second pass in which others work on cores so much of it [s]; where the process is kept then."""
        self.now += 1.0
        self.mine += own
        for core, share in (others or {}).items():
            self.worked[core] += share
        if self.core.core is not None:
            self.worked[self.core.core] += own
        self.core.look(is_slow)
        return self.core.core


@pytest.fixture
def machine() -> Iterator[Machine]:
    found = Machine()
    with found.core:
        yield found
    assert os.sched_getaffinity(0) == set(ALLOWED)


def test_a_process_is_kept_on_the_core_where_others_run_least(machine: Machine) -> None:
    loud = dict.fromkeys(ALLOWED[1:], 0.8)
    assert machine.second(others=loud) is None  # one reading tells nothing
    assert machine.second(others=loud) == ALLOWED[0]
    assert os.sched_getaffinity(0) == {ALLOWED[0]}


def test_every_thread_is_kept_there_and_let_go_at_the_end(machine: Machine) -> None:
    stop, report = threading.Event(), []
    thread = threading.Thread(target=lambda: (stop.wait(10.0), report.append(os.sched_getaffinity(0))))
    thread.start()
    machine.second()
    where = machine.second()
    assert os.sched_getaffinity(thread.native_id or 0) == {where}
    machine.core.__exit__(None, None, None)
    assert os.sched_getaffinity(thread.native_id or 0) == set(ALLOWED)
    stop.set()
    thread.join()
    assert report == [set(ALLOWED)]


def test_it_moves_where_others_crowd_its_core_and_its_own_work_is_no_crowd(machine: Machine) -> None:
    machine.second()
    first = machine.second()
    assert first is not None
    for _ in range(5):
        assert machine.second(own=0.5 * FULL) == first
    assert machine.second(others={first: 0.9 * CROWDED}) == first
    assert machine.second(others={first: 1.5 * CROWDED}) != first


@pytest.mark.parametrize("cause", ["slow", "full"])
def test_a_process_that_needs_more_gets_all_cores_for_a_while(machine: Machine, cause: str) -> None:
    machine.second()
    assert machine.second() is not None
    assert machine.second(own=1.2 * FULL if cause == "full" else 0.2, is_slow=cause == "slow") is None
    assert os.sched_getaffinity(0) == set(ALLOWED)
    places = [machine.second() for _ in range(int(PATIENCE) + 1)]
    assert places[: int(PATIENCE) - 1] == [None] * (int(PATIENCE) - 1)
    assert places[-1] is not None


def test_a_core_that_was_taken_away_is_no_error(machine: Machine) -> None:
    machine.core._allowed = {100_000, 100_001}
    machine.second()
    machine.second()
    assert os.sched_getaffinity(0) == set(ALLOWED)


def test_two_looks_at_nearly_the_same_moment_are_one(machine: Machine) -> None:
    machine.second()
    where = machine.second()
    machine.core.look(False)
    assert machine.core.core == where


def test_the_kernel_tells_of_every_core() -> None:
    report = busy()
    assert set(ALLOWED) <= set(report)
    assert min(report.values()) >= 0.0
