"""A failure is excused only if the machine stood still during it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from standstill import Standstill

TESTS = """
import os, signal, time
import pytest
from standstill import MACHINE

RUNS = []

@pytest.fixture
def stop(request):
    def stop(seconds):
        machine = request.config.stash[MACHINE].pid
        os.kill(machine, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(machine, signal.SIGCONT)
    return stop

def test_fails_once_while_the_machine_stands_still(stop):
    RUNS.append(1)
    stop(0.3)
    assert len(RUNS) == 2

def test_fails_whenever_the_machine_stands_still(stop):
    stop(0.3)
    assert False

def test_fails_after_a_short_pause(stop):
    RUNS.append(1)
    stop(0.02)
    assert len(RUNS) > 3

def test_fails():
    RUNS.append(1)
    assert len(RUNS) > 4

def test_passes_while_the_machine_stands_still(stop):
    stop(0.3)
"""


def may_be_first() -> bool:
    """Whether this process may have real-time scheduling."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


pytestmark = pytest.mark.skipif(not may_be_first(), reason="programs may not have real-time scheduling here")


def test_a_standstill_is_measured_and_the_load_of_others_is_none() -> None:
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    machine = Standstill()
    try:
        while os.sched_getscheduler(machine.pid) != os.SCHED_FIFO:
            time.sleep(0.01)
        time.sleep(0.5)
        start = time.monotonic()
        os.kill(machine.pid, signal.SIGSTOP)
        time.sleep(0.5)
        os.kill(machine.pid, signal.SIGCONT)
        assert machine.since(start) > 0.4
        assert machine.since(time.monotonic()) == 0.0
    finally:
        machine.close()
        for burner in burners:
            burner.kill()
            burner.wait()


@pytest.mark.long
def test_only_a_test_that_failed_meanwhile_is_run_again_and_the_summary_names_it(tmp_path: Path) -> None:
    (tmp_path / "test_machine.py").write_text(TESTS)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "standstill", "-p", "no:cacheprovider", "test_machine.py"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}, capture_output=True, text=True,
    )  # fmt: skip
    assert "3 failed, 2 passed" in done.stdout, done.stdout
    summary = done.stdout.split("run again")[1].split("short test summary")[0]
    assert [line.split(":")[2] for line in summary.splitlines() if "::" in line] == [
        "test_fails_once_while_the_machine_stands_still",
        "test_fails_whenever_the_machine_stands_still",
    ]
