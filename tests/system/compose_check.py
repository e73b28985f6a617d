"""The simulated stack in containers: is a client served, does each container come back, do the motors stay off?

`make test-compose`. With --running the stack is up already, and is left as it is. Exit code 1 if anything is amiss.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hal.errors import CommandRefused, HalError
from services.client import Client
from services.errors import ServiceError

ROOT = Path(__file__).parents[2]
ROBOT = os.environ.get("GEMUCO_ROBOT", "musashi_arm")
ROUTER = "tcp/127.0.0.1:7447"
SERVICES = {"router": "router", "recorder": "recorder", "gemuco": "model", "hal": "hal", "simulator": "simulator"}
"""Container -> service, in the order in which they are killed."""
MOVERS = ("gemuco", "hal", "simulator")
"""Without them nothing may move; without the others the robot goes on."""
UP_WITHIN = 900.0
RECOVERED_WITHIN = 60.0
WATCHED = 3.0
"""How long [s] motors are watched after a container came back."""
KILL = "import os, time; print(time.time(), flush=True); os.kill({pid}, 9)"
FRESH = 0.2
IDLE, LIVE = ("off", "fault"), ("hold", "follow")


class Failed(Exception):
    """The stack does not do what it should."""


def docker(*words: str, timeout: float = 120.0) -> str:
    """What a docker command printed."""
    found = subprocess.run(["docker", *words], cwd=ROOT, capture_output=True, text=True, timeout=timeout, check=False)
    if found.returncode:
        raise Failed(f"docker {' '.join(words)}: {(found.stderr or found.stdout).strip()[-2000:]}")
    return found.stdout.strip()


def eventually(happened: Callable[[], Any], what: str, within: float = RECOVERED_WITHIN) -> None:
    deadline = time.monotonic() + within
    while not happened():
        if time.monotonic() > deadline:
            raise Failed(f"{what}: not within {within:g} s.")
        time.sleep(0.02)


def is_healthy(container: str) -> bool:
    """Whether its own health check says so, now."""
    who = [SERVICES[container], *([] if container == "router" else [ROBOT])]
    try:
        docker("compose", "exec", "-T", container, "python", "-m", "services.health", *who)
    except Failed:
        return False
    return True


def container_of(service: str) -> str:
    return docker("compose", "ps", "-q", service)


def mode(client: Client) -> str:
    """The newest mode of the motors; empty while none is told."""
    applied = client.applied(max_age=FRESH)
    return "" if applied is None else applied.mode


def follow(client: Client) -> None:
    """Engage, and again if the moment was a bad one."""

    def follows() -> bool:
        try:
            if mode(client) == "fault":
                client.reset()
            if mode(client) not in LIVE:
                client.engage()
            client.applied(max_age=FRESH, timeout=1.0)
        except CommandRefused:  # the drives of a HAL that was killed are in fault
            client.reset()
            return False
        except (ServiceError, HalError):
            return False
        return mode(client) == "follow"

    eventually(follows, "the robot follows")


def kill(container: str) -> float:
    """As kill -9 from outside, which a restart policy takes for a crash; `docker kill` would be taken for our wish.

    Returns:
        When [s since 1970].
    """
    name = container_of(container)
    pid, image = docker("inspect", "-f", "{{.State.Pid}} {{.Image}}", name).split()
    rights = ("--pid", "host", "--network", "none", "--user", "0:0", "--cap-drop", "ALL", "--cap-add", "KILL")
    report = docker("run", "--rm", *rights, "--entrypoint", "python", image, "-c", KILL.format(pid=pid))
    return float(report)


def lose(container: str, client: Client) -> dict[str, Any]:
    """Kill a container while the robot follows; how long things took [s] and what the motors did meanwhile."""
    follow(client)
    before = docker("inspect", "-f", "{{.State.StartedAt}}", container_of(container))
    killed = kill(container)
    eventually(
        lambda: (
            docker("inspect", "-f", "{{.State.Status}} {{.State.StartedAt}}", container_of(container))
            not in (f"running {before}", f"exited {before}")
        ),
        f"{container} is started again",
    )
    eventually(lambda: client.estimate(max_age=FRESH, timeout=0.5) is not None, f"estimates after {container}")
    fresh = time.time() - killed
    eventually(lambda: is_healthy(container), f"{container} is healthy")
    healthy = time.time() - killed
    if container in MOVERS:
        eventually(lambda: mode(client) in IDLE, f"motors are off after {container}")
    seen, end = set(), time.monotonic() + WATCHED
    while time.monotonic() < end:
        seen.add(mode(client))
        time.sleep(0.01)
    if container in MOVERS and seen & {*LIVE, "enabling", "homing"}:
        raise Failed(f"Motors came on by themselves after {container} was killed: {sorted(seen)}.")
    print(f"{container}: killed; estimates again after {fresh:.1f} s, healthy after {healthy:.1f} s, modes then {seen}")
    return {"container": container, "estimates": fresh, "healthy": healthy, "modes": sorted(seen - {""})}


def watch_example(lines: int = 5) -> list[str]:
    """What the example of a remote client prints, through the router."""
    command = [sys.executable, "examples/watch_estimates.py", ROBOT, ROUTER]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as example:
        assert example.stdout is not None
        try:
            found = [line for line, _ in zip(example.stdout, range(lines), strict=False)]
        finally:
            example.terminate()
        if len(found) < lines:
            raise Failed(f"The example printed {len(found)} lines: {example.communicate()[1]}")
    return found


def check() -> dict[str, Any]:
    """Everything but up and down; the figures."""
    for container in SERVICES:
        eventually(lambda container=container: is_healthy(container), f"{container} is healthy")
    print("".join(watch_example()), end="")
    with Client(ROBOT, [ROUTER]) as client:
        eventually(lambda: client.estimate(max_age=FRESH, timeout=0.5) is not None, "estimates come")
        if mode(client) not in ("off", ""):
            raise Failed(f"Motors are '{mode(client)}' after the start.")
        follow(client)
        stats = docker("stats", "--no-stream", "--format", "{{.Name}} {{.CPUPerc}} {{.MemUsage}} pids {{.PIDs}}")
        print(stats)
        lost = [lose(container, client) for container in SERVICES]
        client.disengage()
        eventually(lambda: mode(client) in IDLE, "motors are off at the end")
    images = docker("images", "--format", "{{.Repository}}:{{.Tag}} {{.Size}}", "--filter", "reference=gemuco*")
    print(images)
    return {"stats": stats.splitlines(), "images": images.splitlines(), "lost": lost}


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--running", action="store_true", help="the stack is up already")
    parser.add_argument("--json", type=Path, help="where to write the figures")
    options = parser.parse_args()
    os.environ["COMPOSE_PROFILES"] = "simulated"
    try:
        docker("compose", "version")
        docker("version", "--format", "{{.Server.Version}}")
    except (Failed, OSError) as error:
        print(f"skipped: no Docker with compose here ({str(error).splitlines()[0]})")
        return 0
    figures: dict[str, Any] = {}
    try:
        if not options.running:
            docker("compose", "build", timeout=3600.0)
            began = time.monotonic()
            docker("compose", "up", "--detach", "--wait", timeout=UP_WITHIN)
            figures["up"] = time.monotonic() - began
            print(f"up and healthy after {figures['up']:.0f} s")
        figures |= check()
    except (Failed, ServiceError, HalError) as error:
        print(f"FAILED: {error}")
        print(docker("compose", "logs", "--tail", "20"))
        return 1
    finally:
        if not options.running:
            docker("compose", "down", "--volumes", "--timeout", "20")
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(figures, indent=1) + "\n")
    print("All containers came back, and no motor came on by itself.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
