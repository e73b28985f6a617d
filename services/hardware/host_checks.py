"""Checks of this machine: installation, CAN interfaces, clocks, real-time scheduling, memory, processor."""

import ctypes
import os
import platform
import pwd
import resource
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from hal.finding.doctor import Finding, check_controller, ok, warning
from hal.finding.link import known_links, look_up, up_command
from services.extras import EXTRAS, is_missing
from services.hardware.hal_service import CYCLE_PRIORITY

STEADY = 1e-3
"""A steady wall clock moves by at most this much [s] against the monotonic clock within `OBSERVED`."""
OBSERVED = 0.3
"""The two clocks are compared over this time [s]."""
FIRST_PERSON = 1000
"""Users of services have lower numbers."""
USUAL_BITRATE = 1_000_000
"""Without a robot file the bit rate of a bus is not known [bit/s]."""
_TIMEX_BYTES = 256
_MAX_ERROR_AT = 24
"""`maxerror` [us] has this offset in `struct timex` (64 bit)."""
_TIME_ERROR = 5
"""adjtimex(2) returns this value while the clock is not synchronised."""
_FAST_SOURCES = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page", "riscv_clocksource")
_SYSTEM = Path("/sys/devices/system")


def installation() -> Iterator[Finding]:
    """Report versions, optional packages and compiled code."""
    from gemuco.compiled.jit import FOLDER  # numba takes half a second

    yield ok("python", f"{platform.python_version()} on {platform.machine()}, gemuco in {Path(__file__).parents[2]}.")
    absent = [package for package in EXTRAS if is_missing(package)]
    present = [package for package in EXTRAS if package not in absent]
    lacking = f" Not installed: {', '.join(f'{package} ({EXTRAS[package]})' for package in absent)}." if absent else ""
    yield ok("extras", f"{', '.join(present) or 'None'}.{lacking}")
    if FOLDER is None:
        yield warning(
            "compiled code",
            "No folder for it is writable, so every start compiles for a minute. Set NUMBA_CACHE_DIR to one that is.",
        )
    elif not any(FOLDER.rglob("*.nbc")):
        yield ok("compiled code", f"None yet: the first start takes a minute. `python -m gemuco.warm` fills {FOLDER}.")
    else:
        yield ok("compiled code", f"In {FOLDER}.")


def can_interfaces() -> Iterator[Finding]:
    """Report the CAN interfaces of this machine."""
    links = [link for name in known_links() if (link := look_up(name)) is not None]
    for link in links:
        if not link.is_up:
            command = up_command(link.name, link.kind, USUAL_BITRATE)
            yield warning(f"interface {link.name}", f"{link.kind or 'can'}, down. Bring it up: `{command}`.")
            continue
        rate = f", {link.bitrate / 1e6:g} Mbit/s" if link.bitrate else ""
        yield ok(f"interface {link.name}", f"{link.kind or 'can'}, up{rate}.")
        if link.kind == "can":
            yield from check_controller(link.name, link)
    if not links:
        yield ok("interfaces", "No CAN interface. Simulated robots need none.")


def clocks() -> Iterator[Finding]:
    """Check that the wall clock is synchronised and steady, and that its source is fast to read."""
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)
    state = ctypes.CDLL(None, use_errno=True).adjtimex(timex)
    error = int.from_bytes(timex.raw[_MAX_ERROR_AT : _MAX_ERROR_AT + 8], "little") * 1e-6
    if state == _TIME_ERROR or state < 0:
        yield warning(
            "wall clock",
            "Not synchronised: stamps of several machines do not agree. Run `timedatectl set-ntp true` or chrony.",
        )
    else:
        yield ok("wall clock", f"Synchronised; largest error {error * 1e3:.3g} ms.")
    before = time.time() - time.monotonic()
    time.sleep(OBSERVED)
    moved = abs(time.time() - time.monotonic() - before)
    if moved > STEADY:
        yield warning("clock steps", f"The wall clock moved by {moved * 1e3:.3g} ms within {OBSERVED} s. What sets it?")
    else:
        yield ok("clock steps", f"Wall clock and monotonic clock agree within {moved * 1e6:.0f} us over {OBSERVED} s.")
    source = _read(_SYSTEM / "clocksource/clocksource0/current_clocksource")
    if source and source not in _FAST_SOURCES:
        yield warning("clock source", f"'{source}' is slow to read. Is `tsc` usable on this machine?")
    else:
        yield ok("clock source", source or "This system does not report it.")


def real_time() -> Iterator[Finding]:
    """Check that the HAL's threads can run before all others without waiting for memory or the processor."""
    refusal = _try_fifo()
    if refusal:
        yield warning(
            "scheduling",
            f"No real-time priority ({refusal}). Put `@robot - rtprio 90` into /etc/security/limits.conf, or give the "
            "container CAP_SYS_NICE.",
        )
    else:
        yield ok("scheduling", f"SCHED_FIFO {CYCLE_PRIORITY} is allowed.")
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    swaps = (_read(Path("/proc/swaps")) or "").splitlines()[1:]
    lockable = "no limit" if limit == resource.RLIM_INFINITY else f"{limit / 2**20:.0f} MiB"
    if swaps and limit != resource.RLIM_INFINITY:
        yield warning(
            "memory",
            f"Swap is on, and only {lockable} may be locked: a swapped page costs a cycle. Run `sudo swapoff -a`.",
        )
    else:
        yield ok("memory", f"{'Swap' if swaps else 'No swap'}; lockable memory: {lockable}.")
    slow = sorted({governor for governor in _governors() if governor in ("powersave", "ondemand", "conservative")})
    if slow:
        yield warning(
            "processor", f"Governor {', '.join(slow)} reacts slowly. Run `sudo cpupower frequency-set -g performance`."
        )
    else:
        yield ok("processor", f"{os.cpu_count()} cores, governor {', '.join(sorted(set(_governors()))) or 'unknown'}.")


def other_users(has_role_file: bool) -> Iterator[Finding]:
    """Report the users of this machine who can command the robot, which without role files are all of them."""
    if has_role_file:
        yield ok("users", "A role file is used, so other users of this machine need one to command the robot.")
        return
    names = [user.pw_name for user in pwd.getpwall() if user.pw_uid != os.geteuid() and _may_log_in(user)]
    text = "Without role files every user and program of this machine can enable motors and command the robot"
    if names:
        known = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
        yield warning("users", f"{text}: {known} can log in here. Run `gemuco security init`, also for one machine.")
    else:
        yield ok("users", f"{text}; only root and this user can log in here.")


def _may_log_in(user: pwd.struct_passwd) -> bool:
    return user.pw_uid >= FIRST_PERSON and not user.pw_shell.endswith(("nologin", "false", "sync"))


def _try_fifo() -> str:
    """Return why a thread of this process cannot have real-time priority; empty if it can."""
    refusal = ""

    def attempt() -> None:
        nonlocal refusal
        try:
            flags = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, flags, os.sched_param(CYCLE_PRIORITY))
        except OSError as error:
            refusal = error.strerror or str(error)

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    return refusal


def _governors() -> list[str]:
    files = _SYSTEM.glob("cpu/cpu*/cpufreq/scaling_governor")
    return [text for text in map(_read, files) if text]


def _read(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except OSError:
        return None
