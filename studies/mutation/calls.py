"""A pytest plugin that records the duration [s] of each test that passes, and the functions of this project that it
calls if `TRACE` is in the environment.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest

ROOT = str(Path.cwd()) + os.sep
_calls: dict[int, CodeType] = {}
_tests: dict[str, tuple[float, list[str]]] = {}
_failed: set[str] = set()


def _note(frame: FrameType, event: str, argument: Any) -> None:
    _calls[id(frame.f_code)] = frame.f_code


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Record the duration of one test, and its calls in all threads."""
    _calls.clear()
    started = time.perf_counter()
    if os.environ["TRACE"]:
        threading.settrace(_note)
        sys.settrace(_note)
    result = yield
    sys.settrace(None)
    duration = time.perf_counter() - started
    ours = [code for code in list(_calls.values()) if code.co_filename.startswith(ROOT)]
    names = {f"{code.co_filename.removeprefix(ROOT)}:{code.co_qualname}" for code in ours}
    _tests[item.nodeid] = round(duration, 3), sorted(name for name in names if not name.startswith("tests"))
    return result


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note a test that does not pass."""
    if report.outcome != "passed":
        _failed.add(report.nodeid)


def pytest_sessionfinish() -> None:
    """Write the file that the environment names."""
    passed = {name: entry for name, entry in _tests.items() if name not in _failed}
    Path(os.environ["CALLS"]).write_text(json.dumps(passed))
