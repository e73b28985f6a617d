"""Settings of the C library, in a process of their own."""

import subprocess
import sys

import pytest

HEAPS = """
import ctypes, threading
from services.process.realtime import share_heaps
if {shared}:
    share_heaps()
libc, all_here = ctypes.CDLL(None), threading.Barrier(9)
def allocate():
    libc.malloc(50_000)
    all_here.wait()
    all_here.wait()
for _ in range(8):
    threading.Thread(target=allocate).start()
all_here.wait()
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
libc.fflush(None)
all_here.wait()
"""


@pytest.mark.parametrize(("shared", "heaps"), [(True, {1, 2}), (False, set(range(3, 17)))])
def test_threads_share_two_heaps_of_the_library(shared: bool, heaps: set[int]) -> None:
    program = [sys.executable, "-c", HEAPS.format(shared=shared)]
    report = subprocess.run(program, capture_output=True, text=True, check=True, timeout=60).stdout
    if "<heap" not in report:
        pytest.skip("this C library has no malloc_info")
    assert report.count("<heap nr=") in heaps
