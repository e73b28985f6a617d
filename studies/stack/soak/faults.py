"""Faults of the soak: each begins at a call, and ends with the context that the call returns."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hal.errors import HalError
from services.client import Client
from services.errors import NoAnswer, ServiceError
from studies.stack.light_robot import JOINT, JOINTS, LOAD, MOTOR
from studies.stack.soak.robot import Robot

PATIENCE = 15.0
FLOOD_SECONDS = 6.0
LEFT_FREE = 1 << 20
"""A full disk has this many bytes left."""
NODES = {JOINT: "encoder", LOAD: "cell", MOTOR: "drive"}
LIES = (
    "sensor_offset",
    "sensor_frozen",
    "sensor_flipped",
    "sensor_drift",
    "sensor_gain",
    "sensor_noisy",
    "sensor_stuck",
    "sensor_delayed",
)
SIZES = {
    "sensor_offset": (4.0, 6.0, 20.0),
    "sensor_drift": (1.0, 4.0, 16.0),
    "sensor_noisy": (6.0, 12.0, 30.0),
    "sensor_stuck": (0.3, 0.3, 0.3),
}
"""Sizes of lies [promised std; a drift: per second], for the signals in order."""
FACTORS = {"sensor_gain": (0.4, 0.8, 1.5), "sensor_delayed": (0.2, 0.3, 0.5)}
"""Factors and delays [s], for the signals in order."""
KILLED = ("model", "hal", "simulator", "recorder", "router")

Fault = Callable[[], contextlib.AbstractContextManager[dict[str, Any]]]


class Faults:
    """All faults of one robot, by name.

    Args:
        robot: The processes.
        client: The operator.
        promised: Signal -> promised std of each element, for the sizes of lies.
        is_disk: Whether the robot's folder is a disk of its own, which may be filled.
    """

    def __init__(self, robot: Robot, client: Client, promised: Mapping[str, np.ndarray], is_disk: bool) -> None:
        self._robot, self._client, self._promised = robot, client, promised
        self.by_name: dict[str, Fault] = {f"kill {name}": self._kill(name) for name in KILLED}
        for number, (signal_name, kind) in enumerate((of, lie) for lie in LIES for of in NODES):
            joint = number % len(JOINTS)
            self.by_name[f"{kind.removeprefix('sensor_')} {signal_name}"] = self._lie(kind, signal_name, joint, number)
        for index, name in enumerate(JOINTS):
            self.by_name[f"silent {name}"] = self._node("sensor_silent", f"{name}_encoder", index)
        self.by_name["emcy"] = self._node("emcy", f"{JOINTS[0]}_drive", 0)
        self.by_name["reboot"] = self._node("node_reboot", f"{JOINTS[1]}_drive", 1)
        self.by_name["replay"] = self._program("replay")
        self.by_name["flood"] = self._program("flood")
        if is_disk:
            self.by_name["full disk"] = self._full_disk

    def schedule(self, minutes: int, with_kills: int) -> list[str]:
        """Return the fault of each minute: the first `with_kills` alternate with kills; all others take turns."""
        kills = [name for name in self.by_name if name.startswith("kill")]
        special = [name for name in self.by_name if name in ("replay", "flood", "full disk")]
        lies = [name for name in self.by_name if name not in (*kills, *special)]
        plan = []
        for number in range(minutes):
            if number < with_kills and number % 2 == 0:
                plan.append(kills[number // 2 % len(kills)])
            elif number % 4 == 3:
                plan.append(special[number // 4 % len(special)])
            else:
                plan.append(lies[5 * number % len(lies)])
        return plan

    def insist(self, act: Callable[[], object]) -> int:
        """Call until a service answers, for at most `PATIENCE`; return the number of calls without an answer."""
        deadline, unanswered = time.monotonic() + PATIENCE, 0
        while True:
            try:
                act()
            except NoAnswer:
                unanswered += 1
                if time.monotonic() > deadline:
                    return unanswered
            else:
                return unanswered

    def _kill(self, name: str) -> Fault:
        @contextlib.contextmanager
        def killed() -> Iterator[dict[str, Any]]:
            self._robot.kill(name)
            yield {"kind": "kill"}

        return killed

    def _lie(self, kind: str, signal_name: str, joint: int, number: int) -> Fault:
        node, element = f"{JOINTS[joint]}_{NODES[signal_name]}", f"{signal_name}.{JOINTS[joint]}"
        words = [kind, node]
        if kind in SIZES:
            words.append(f"{SIZES[kind][number % len(NODES)] * self._promised[signal_name][joint]:.4g}")
        elif kind in FACTORS:
            words.append(str(FACTORS[kind][number % len(NODES)]))

        @contextlib.contextmanager
        def lying() -> Iterator[dict[str, Any]]:
            row: dict[str, Any] = {
                "kind": "lie",
                "unanswered": self.insist(lambda: self._client.fault(" ".join(words))),
            }
            yield row
            row["noticed"] = self._noticed(element)
            row["unanswered"] += self.insist(lambda: self._client.fault(f"sensor_true {node}"))

        return lying

    def _noticed(self, element: str) -> str:
        """Return the reason for which HAL or model do not use an element; empty if they use it."""
        estimate = self._client.estimate(timeout=1.0)
        status = self._client.status("hal", timeout=2.0)
        if estimate is not None and element in estimate.distrusted:
            return estimate.distrusted[element]
        return "" if status is None else str(status.facts.get("implausible", {}).get(element, ""))

    def _node(self, kind: str, node: str, index: int) -> Fault:
        @contextlib.contextmanager
        def broken() -> Iterator[dict[str, Any]]:
            row: dict[str, Any] = {"kind": "silent" if kind == "sensor_silent" else "node", "index": index}
            row["unanswered"] = self.insist(lambda: self._client.fault(f"{kind} {node}"))
            yield row
            row["unanswered"] += self.insist(lambda: self._client.fault(f"node_back {node}"))

        return broken

    def _program(self, kind: str) -> Fault:
        @contextlib.contextmanager
        def running() -> Iterator[dict[str, Any]]:
            row: dict[str, Any] = {"kind": kind}
            with Program(kind, self._robot.name, self._robot.router) as program:
                if kind == "flood":
                    time.sleep(FLOOD_SECONDS)
                    row |= program.end()
                yield row
                if kind != "flood":
                    row |= program.end()

        return running

    @contextlib.contextmanager
    def _full_disk(self) -> Iterator[dict[str, Any]]:
        """Fill the disk of the robot's folder: recordings, logs, locks and heartbeats are on it."""
        filling = self._robot.supervisor.folder / "filling"
        row: dict[str, Any] = {"kind": "full disk"}
        try:
            fill(filling)
            yield row
            status = self._client.status("recorder", timeout=3.0)
            row["recorder"] = "" if status is None else status.text
        finally:
            filling.unlink(missing_ok=True)
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            status = self._client.status("recorder", timeout=3.0)
            if status is not None and not status.facts["failure"]:
                return
            time.sleep(0.5)
        row["never"] = "" if status is None else status.facts["failure"]

    def believe_again(self) -> int:
        """Trust, as an operator does after a repair, what is still distrusted; return its number."""
        count = 0
        with contextlib.suppress(ServiceError, HalError):
            estimate = self._client.estimate(timeout=1.0)
            for element in {} if estimate is None else estimate.distrusted:
                self._client.trust(element)
                count += 1
        return count


class Program:
    """A program of `studies.stack.soak.others` in a process of its own; a context manager."""

    def __init__(self, kind: str, robot: str, router: str) -> None:
        command = [sys.executable, "-m", "studies.stack.soak.others", kind, robot, router]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def __enter__(self) -> "Program":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()

    def end(self) -> dict[str, Any]:
        """End it, and return its counts."""
        self.process.send_signal(signal.SIGTERM)
        text, _ = self.process.communicate(timeout=PATIENCE)
        return dict(json.loads(text)) if text else {}


@contextlib.contextmanager
def own_disk(folder: Path, megabytes: int) -> Iterator[bool]:
    """Mount a disk of its own, in memory, at a folder; yield whether this was possible, for which one must be root."""
    folder.mkdir(parents=True, exist_ok=True)
    options = ["-t", "tmpfs", "-o", f"size={megabytes}m,mode=700", "tmpfs", str(folder)]
    is_mounted = os.geteuid() == 0 and subprocess.run(["mount", *options], check=False).returncode == 0
    try:
        yield is_mounted
    finally:
        if is_mounted:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(path: Path) -> None:
    """Write a file until the disk is full."""
    disk = os.statvfs(path.parent)
    with path.open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(1, disk.f_bavail * disk.f_frsize - LEFT_FREE))
    with contextlib.suppress(OSError), path.open("ab") as file:
        while True:
            file.write(bytes(1 << 16))
            file.flush()
