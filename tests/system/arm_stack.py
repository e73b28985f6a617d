"""Simulated nodes, HAL and model of the shipped arm, as processes, under a name of its own."""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import yaml

from gemuco.checkpoint import save
from hal.config import load_robot
from hal.errors import CommandRefused
from services.client import Client
from services.errors import NotEngaged
from services.model.artifacts import fingerprint
from services.process.supervisor import Supervisor, gemuco_command

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tests" / "services"))
from arm_model import small_model  # noqa: E402

RATES = {"hal": 100, "estimation": 100, "control": 50, "anomaly": 50, "update": 10}
"""Half of what the arm turns at, so that the tests' machine has room for it [Hz]."""
PATIENCE = 30.0
"""Longer than anything takes, on a machine with other work [s]."""


def eventually(condition: Callable[[], bool], timeout: float = PATIENCE) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)


class Stack:
    """The processes of one robot, started and killed by name."""

    def __init__(self, folder: Path, robot: str) -> None:
        self.folder, self.robot = folder, robot
        description = yaml.safe_load((ROOT / "robots" / "musashi_arm.yaml").read_text())
        description["robot"], description["rates"] = robot, RATES
        for bus in description["buses"]:
            description["buses"][bus]["channel"] = f"{robot}_{bus}"
        for kind in description["kinds"].values():
            kind["settings"]["eds"] = str(ROOT / "robots" / kind["settings"]["eds"])
        self.file = folder / f"{robot}.yaml"
        self.file.write_text(yaml.safe_dump(description, sort_keys=False))
        self.model = folder / "runs" / robot / "model"
        save(small_model().with_manifest(fingerprint=fingerprint(load_robot(self.file))), self.model)
        self.supervisor = Supervisor(folder / "logs")
        self.client = Client(robot)
        self.commands = {
            "simulator": ("simulate", str(self.file)),
            "hal": ("hal", str(self.file)),
            "model": ("serve", str(self.file), "--model", str(self.model)),
        }

    def start(self, *names: str) -> None:
        for name in names:
            self.supervisor.start(name, gemuco_command(*self.commands[name]))
            self.supervisor.wait_ready(name, lambda name=name: self.state(name) == "running", PATIENCE)

    def state(self, service: str) -> str:
        status = self.client.status(service)
        return "" if status is None else status.state

    def method(self) -> str:
        estimate = self.client.estimate()
        return "" if estimate is None else estimate.method["joint_position"]

    def is_measured(self) -> bool:
        """Whether every element of every signal is measured, also those of drives that take longer to configure."""
        sample = self.client.sample(timeout=0.5)
        return sample is not None and all(bool(valid.all()) for valid in sample.valid.values())

    def mode(self) -> str:
        applied = self.client.applied(timeout=0.5)
        return "" if applied is None else applied.mode

    def engage(self) -> None:
        def follows() -> bool:
            if self.mode() == "fault":
                self.client.reset()
            try:
                if self.mode() not in ("hold", "follow"):
                    self.client.engage()
            except (NotEngaged, CommandRefused):
                return False  # a moment without a fresh sample, or a drive that is not ready yet
            return self.mode() == "follow"

        eventually(follows)
