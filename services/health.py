"""The health check of a service: every service writes the progress of its loops into a file once a second.

`python -m services.health SERVICE ROBOT` reads that file and prints one line; exit code 0 if the service is healthy. It
imports as little as possible, so that a container can run it every few seconds.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

from services.errors import ServiceError
from services.runtime import runtime_folder

ROUTER = "router"
"""This is the only service that belongs to no robot."""
STALE = 3.0
"""A service whose heartbeat is older than this [s] is frozen."""
STUCK = 3.0
"""A loop without progress for this time [s], or for five periods if that is longer, is stuck."""
_START_TIME_FIELD = 19
"""This field of /proc/PID/stat is the start time, counted after the name in parentheses."""


def heartbeat_path(service: str, robot: str) -> Path:
    """Return the path of a service's heartbeat; the router's robot is empty."""
    return runtime_folder() / ".".join(filter(None, (robot, service, "heartbeat")))


def judge(heartbeat: dict[str, Any], now: float) -> str:
    """Return the fault of a service in one sentence; empty if it is healthy.

    Args:
        heartbeat: Content of its file.
        now: Monotonic time [s].
    """
    if heartbeat["boot"] != this_boot():
        return "The heartbeat is from before this machine started: the service does not run."
    pid = heartbeat["pid"]
    if heartbeat["space"] == pid_space() and started(pid) != heartbeat["started"]:
        return f"Process {pid} was killed or has crashed."
    age = now - heartbeat["stamp"]
    if age > STALE:
        return f"No heartbeat of process {pid} for {age:.1f} s: frozen, or without processor time."
    for name, loop in heartbeat["loops"].items():
        idle = now - loop["at"]
        if idle > max(STUCK, 5.0 * loop["period"]):
            error = f" Last error: {loop['error']}" if loop["error"] else ""
            return f"Loop '{name}' of process {pid} has completed nothing for {idle:.1f} s.{error}"
    return ""


def check(service: str, robot: str) -> tuple[bool, str]:
    """Return whether a service of this machine is healthy, and the reason in one line."""
    try:
        path = heartbeat_path(service, robot)
        heartbeat = json.loads(path.read_text())
        fault = judge(heartbeat, time.monotonic())
    except ServiceError as error:
        return False, str(error)
    except FileNotFoundError:
        return False, f"No '{service}' runs here, or it is still starting: there is no '{path}'."
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        return False, f"The heartbeat '{path}' cannot be read: {error!r}."
    if fault:
        return False, fault
    loops = ", ".join(f"{name} {loop['done']}" for name, loop in heartbeat["loops"].items())
    return True, f"Process {heartbeat['pid']} is healthy; completed: {loops}."


def this_boot() -> str:
    """Return the random identifier of the machine's last start."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def pid_space() -> str:
    """Return the namespace of this process's pids; pids of another namespace cannot be looked up here."""
    return str(Path("/proc/self/ns/pid").readlink())


def started(pid: int) -> str:
    """Return the start time of a process [kernel ticks], because pids are used again; empty without a process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[_START_TIME_FIELD]
    except (OSError, IndexError):
        return ""


def main(arguments: list[str]) -> int:
    """Run the command; return exit code 0 if the service is healthy, 1 if not, 2 for wrong arguments."""
    if not 1 <= len(arguments) <= 2:
        print("usage: python -m services.health SERVICE [ROBOT]", file=sys.stderr)
        return 2
    is_healthy, text = check(arguments[0], arguments[1] if len(arguments) == 2 else "")
    print(text)
    return 0 if is_healthy else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
