"""The processes of a light robot: router, simulator, HAL, model and recorder, each of which can be killed."""

import contextlib
import os
import socket
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from hal.config import RobotConfig, load_robot
from services.client import Client
from services.errors import ServiceError
from services.process.supervisor import Supervisor, gemuco_command
from studies.stack import light_model, light_robot

RATE = 50.0
"""HAL and estimation run at this rate [Hz], which is low because other work runs on the machine too."""
READY_WITHIN = 300.0
"""Time [s] for one process to start on a busy machine."""
FILE_SECONDS = 120
"""Time [s] that one file of the recorder covers; its index stays in memory until then."""
SERVICES = {"simulator": "simulator", "hal": "hal", "model": "model", "recorder": "recorder"}
"""Process -> service."""


class Robot:
    """Router and services of a light robot as processes.

    Args:
        supervisor: Starts and stops them; its folder has their logs.
        name: The robot's name.
        model: Folder of the model, which is trained if it has none.
    """

    def __init__(self, supervisor: Supervisor, name: str, model: Path) -> None:
        self.supervisor, folder = supervisor, supervisor.folder
        self.file = light_robot.write(folder, name, RATE, True)
        self.config: RobotConfig = load_robot(self.file)
        self.name, self.recordings = name, folder / "recordings"
        self.router = f"tcp/127.0.0.1:{free_port()}"
        self.tracebacks: Counter[str] = Counter()
        """Process -> number of tracebacks in the logs of its former lives."""
        light_model.make(self.file, model)
        self.recordings.mkdir(exist_ok=True)
        connect = ("--connect", self.router)
        record = (str(self.recordings / "soak.mcap"), "--max-seconds", str(FILE_SECONDS))
        self.commands = {
            "router": gemuco_command("router", "--listen", self.router),
            "simulator": gemuco_command("simulate", str(self.file), *connect),
            "hal": gemuco_command("hal", str(self.file), *connect),
            "model": gemuco_command("serve", str(self.file), "--model", str(model), *connect),
            "recorder": gemuco_command("record", str(self.file), *record, *connect),
        }

    def start_router(self) -> None:
        """Start the router; a client can connect after a moment."""
        self.supervisor.start("router", self.commands["router"])

    def start(self, client: Client, *processes: str) -> None:
        """Start services, all by default, each when the one before is ready."""
        for name in processes or tuple(SERVICES):
            self.supervisor.start(name, self.commands[name])

            def is_running(service: str = SERVICES[name]) -> bool:
                status = client.status(service)
                return status is not None and status.state in ("running", "degraded")

            self.supervisor.wait_ready(name, is_running, READY_WITHIN)

    def kill(self, name: str) -> None:
        """Kill a process (SIGKILL) and start it again at once, without waiting for it."""
        self.tracebacks[name] += self._tracebacks(name)
        self.supervisor.kill(name)
        self.supervisor.start(name, self.commands[name])

    def all_tracebacks(self) -> dict[str, int]:
        """Return process -> number of tracebacks in its logs so far; only of those that have any."""
        counts = {name: self.tracebacks[name] + self._tracebacks(name) for name in self.commands}
        return {name: count for name, count in counts.items() if count}

    def pids(self) -> dict[str, int]:
        """Return process -> its number."""
        return {name: child.process.pid for name, child in self.supervisor.children.items()}

    def tidy(self) -> None:
        """Remove all recordings but the newest three."""
        for path in sorted(self.recordings.glob("*.mcap"), key=lambda path: path.stat().st_mtime)[:-3]:
            path.unlink()

    def _tracebacks(self, name: str) -> int:
        child = self.supervisor.children.get(name)
        return 0 if child is None else child.log.read_text(errors="replace").count("Traceback (most recent call last)")


def free_port() -> int:
    """Return a port that is free at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def client_of(robot: str, router: str) -> Iterator[Client]:
    """Connect a client to a router that may still be starting.

    Raises:
        ServiceError: There is no router within `READY_WITHIN`.
    """
    with contextlib.ExitStack() as stack:
        yield _connected(stack, robot, router)


def _connected(stack: contextlib.ExitStack, robot: str, router: str) -> Client:
    deadline = time.monotonic() + READY_WITHIN
    while True:
        try:
            return stack.enter_context(Client(robot, (router,), name=f"soak {os.getpid()}"))
        except ServiceError:  # not there, or too busy for an answer
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)
