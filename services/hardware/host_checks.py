"""Whether this machine keeps time, and lets the HAL keep it: clocks, real-time scheduling, memory, processor."""

import ctypes
import os
import resource
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from hal.finding.doctor import Finding, ok, warning
from services.hardware.hal_service import CYCLE_PRIORITY

STEADY = 1e-3
"""Largest change [s] of the offset between wall clock and monotonic clock while they are watched."""
WATCHED = 0.3
_TIMEX_BYTES = 256
_MAX_ERROR_AT = 24
"""Where `maxerror` [us] is in `struct timex` (64 bit)."""
_TIME_ERROR = 5
"""What adjtimex(2) returns while the clock is not synchronised."""
_QUICK_SOURCES = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page", "riscv_clocksource")
_SYSTEM = Path("/sys/devices/system")


def clocks() -> Iterator[Finding]:
    """Is the wall clock synchronised and steady, and is the clock source a quick one?"""
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)
    state = ctypes.CDLL(None, use_errno=True).adjtimex(timex)
    error = int.from_bytes(timex.raw[_MAX_ERROR_AT : _MAX_ERROR_AT + 8], "little") * 1e-6
    if state == _TIME_ERROR or state < 0:
        yield warning(
            "wall clock",
            "Not synchronised: stamps of several machines do not agree. `timedatectl set-ntp true`, or run chrony.",
        )
    else:
        yield ok("wall clock", f"Synchronised, at most {error * 1e3:.3g} ms off.")
    before = time.time() - time.monotonic()
    time.sleep(WATCHED)
    moved = abs(time.time() - time.monotonic() - before)
    if moved > STEADY:
        yield warning("clock steps", f"The wall clock moved by {moved * 1e3:.3g} ms within {WATCHED} s. What sets it?")
    else:
        yield ok("clock steps", f"Wall clock and monotonic clock agree within {moved * 1e6:.0f} us over {WATCHED} s.")
    source = _read(_SYSTEM / "clocksource/clocksource0/current_clocksource")
    if source and source not in _QUICK_SOURCES:
        yield warning("clock source", f"'{source}' is slow to read. Is `tsc` usable on this machine?")
    else:
        yield ok("clock source", source or "not told by this system.")


def real_time() -> Iterator[Finding]:
    """May the HAL's threads run before all others, and is there anything that holds them up?"""
    refused = _try_fifo()
    if refused:
        yield warning(
            "scheduling",
            f"No real-time priority ({refused}). Put `@robot - rtprio 90` into /etc/security/limits.conf, or give the "
            "container CAP_SYS_NICE.",
        )
    else:
        yield ok("scheduling", f"SCHED_FIFO {CYCLE_PRIORITY} is allowed.")
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    swaps = (_read(Path("/proc/swaps")) or "").splitlines()[1:]
    told = "no limit" if limit == resource.RLIM_INFINITY else f"{limit / 2**20:.0f} MiB"
    if swaps and limit != resource.RLIM_INFINITY:
        yield warning(
            "memory",
            f"There is swap, and only {told} may be locked: a page that is away costs a cycle. `sudo swapoff -a`.",
        )
    else:
        yield ok("memory", f"{'No swap' if not swaps else 'Swap'}; memory that may be locked: {told}.")
    slow = sorted({governor for governor in _governors() if governor in ("powersave", "ondemand", "conservative")})
    if slow:
        yield warning(
            "processor", f"Governor {', '.join(slow)} wakes up slowly. `sudo cpupower frequency-set -g performance`."
        )
    else:
        yield ok("processor", f"{os.cpu_count()} cores, governor {', '.join(sorted(set(_governors()))) or 'not told'}.")


def _try_fifo() -> str:
    """Why a thread of this process cannot have real-time priority; empty if it can."""
    found = []

    def attempt() -> None:
        try:
            flags = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, flags, os.sched_param(CYCLE_PRIORITY))
        except OSError as error:
            found.append(error.strerror or str(error))

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    return found[0] if found else ""


def _governors() -> list[str]:
    files = _SYSTEM.glob("cpu/cpu*/cpufreq/scaling_governor")
    return [text for text in map(_read, files) if text]


def _read(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except OSError:
        return None
