"""Tell a live service from a stuck one, from outside: each writes once a second how far its loops are.

`python -m services.health SERVICE ROBOT` looks at that file and prints one line; exit code 0 if the service is healthy.
It imports as little as possible, so that a container can ask every few seconds.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

from services.errors import ServiceError
from services.runtime import runtime_folder

ROUTER = "router"
"""The one service that belongs to no robot."""
STALE = 3.0
"""A service that wrote nothing for so long [s] is frozen."""
STUCK = 3.0
"""A loop that completed nothing for so long [s] is stuck; a slow one has five periods."""
_STARTED_AT = 19
"""Where a process's start time is in /proc/PID/stat, counted after the name in parentheses."""


def heartbeat_path(service: str, robot: str) -> Path:
    """Where a service writes how far it is; the router's robot is empty."""
    return runtime_folder() / ".".join(filter(None, (robot, service, "heartbeat")))


def judge(found: dict[str, Any], now: float) -> str:
    """What is wrong with a service that wrote this, in one sentence; empty if nothing is.

    Args:
        found: What the file holds.
        now: Monotonic time [s].
    """
    if found["boot"] != this_boot():
        return "The heartbeat is from before this machine started: the service does not run."
    pid = found["pid"]
    if found["space"] == pid_space() and started(pid) != found["started"]:
        return f"Process {pid} has ended without a word: killed, or crashed."
    age = now - found["stamp"]
    if age > STALE:
        return f"No heartbeat of process {pid} for {age:.1f} s: frozen, or without processor time."
    for name, loop in found["loops"].items():
        still = now - loop["at"]
        if still > max(STUCK, 5.0 * loop["period"]):
            why = f" Last error: {loop['error']}" if loop["error"] else ""
            return f"Loop '{name}' of process {pid} has completed nothing for {still:.1f} s.{why}"
    return ""


def check(service: str, robot: str) -> tuple[bool, str]:
    """Whether a service of this machine is healthy, and one line that tells why."""
    try:
        path = heartbeat_path(service, robot)
        found = json.loads(path.read_text())
        problem = judge(found, time.monotonic())
    except ServiceError as error:
        return False, str(error)
    except FileNotFoundError:
        return False, f"No '{service}' runs here, or it is still starting: there is no '{path}'."
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        return False, f"The heartbeat '{path}' cannot be read: {error!r}."
    if problem:
        return False, problem
    loops = ", ".join(f"{name} {loop['done']}" for name, loop in found["loops"].items())
    return True, f"Process {found['pid']} is healthy; completed: {loops}."


def this_boot() -> str:
    """Random, and another one after the machine was started again."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def pid_space() -> str:
    """Which namespace pids count in; another one's cannot be looked up here."""
    return str(Path("/proc/self/ns/pid").readlink())


def started(pid: int) -> str:
    """When a process started [ticks of the kernel]; empty if there is none: pids are used again."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[_STARTED_AT]
    except (OSError, IndexError):
        return ""


def main(arguments: list[str]) -> int:
    """The command: exit code 0 if the service is healthy, 1 if not."""
    if not 1 <= len(arguments) <= 2:
        print("usage: python -m services.health SERVICE [ROBOT]", file=sys.stderr)
        return 2
    is_healthy, text = check(arguments[0], arguments[1] if len(arguments) == 2 else "")
    print(text)
    return 0 if is_healthy else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
