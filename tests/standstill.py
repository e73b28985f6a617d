"""A test that failed while the whole machine stood still is run once more, and the summary says so.

A virtual machine is stopped for up to seconds while its server runs others. What a test says of 20 ms does not hold
then, and no program could make it hold. A process without work, which runs before all others, shows when that was: the
load of the tests themselves does not delay it, so it excuses nothing that they do to each other.
"""

import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

WATCH = Path(__file__).with_name("watch_machine.py")
MOST = 5
"""At most this number of tests are run again. A machine that stands still more often shows nothing."""


class Standstill:
    """Times for which the machine stood still; none where programs may not have real-time scheduling."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-S", str(WATCH)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self._times: list[tuple[float, float]] = []
        self._rest = b""

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def since(self, start: float) -> float:
        """Return for how long [s] the machine stood still since a moment [monotonic s]."""
        time.sleep(0.05)
        assert self._process.stdout is not None
        with suppress(BlockingIOError):
            while read := os.read(self._process.stdout.fileno(), 65536):
                self._rest += read
        *lines, self._rest = self._rest.split(b"\n")
        for line in lines:
            end, length = line.split()
            self._times.append((float(end), float(length)))
        return sum(length for end, length in self._times if end >= start)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        for end in (self._process.stdin, self._process.stdout):
            assert end is not None
            end.close()


MACHINE = pytest.StashKey[Standstill]()
REPEATED = pytest.StashKey[list[str]]()


def pytest_sessionstart(session: pytest.Session) -> None:
    """Begin to watch the machine."""
    session.config.stash[MACHINE], session.config.stash[REPEATED] = Standstill(), []


def pytest_sessionfinish(session: pytest.Session) -> None:
    """End the process."""
    session.config.stash[MACHINE].close()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    """Run a test, and once more if it failed while the machine stood still."""
    repeated, start = item.config.stash[REPEATED], time.monotonic()
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    reports = runtestprotocol(item, nextitem=nextitem, log=False)
    if any(report.failed for report in reports) and len(repeated) < MOST:
        still = item.config.stash[MACHINE].since(start)
        if still:
            repeated.append(f"{item.nodeid}: the machine stood still for {still:.2f} s while it failed")
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print which tests were run again."""
    if config.stash[REPEATED]:
        terminalreporter.section("run again")
    for line in config.stash[REPEATED]:
        terminalreporter.write_line(line)
