"""The HAL's process killed and frozen while the robot moves; drives and world go on in real time in this process."""

import contextlib
import json
import queue
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from pathlib import Path

from wire_bench import DRIVES, STEP, TENSION_RAMP, WINDOW, WitnessWorld, wire_description, wire_hardware

from hal.config import RobotConfig
from simulators.nodes.cia402.states import State
from simulators.rig import Rig

MASTER = Path(__file__).with_name("master.py")
PATIENCE = 30.0
"""[s] for what takes one or two, on a machine with other work."""
WATCH = 0.15 + 0.02 + 2 * STEP
"""From the last heartbeat until a drive stops by itself [s]: 1016h, the period of the heartbeat, and its own look."""
POWER = WATCH + 0.5
"""And until it is without power, after the longest quick stop [s]."""
OLD = 0.02 + 0.01 + 0.1
"""Older [s] no valid value may be: its limit, a cycle, and what this machine may be late."""


class Master:
    """The process of the HAL, from its parent's side."""

    def __init__(self, path):
        self._process = subprocess.Popen(
            [sys.executable, str(MASTER), str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._lines = queue.SimpleQueue()
        self.report = deque(maxlen=1000)
        threading.Thread(target=lambda: [self._lines.put(line) for line in self._process.stdout], daemon=True).start()

    def say(self, order):
        self._process.stdin.write(f"{order}\n")
        self._process.stdin.flush()

    def until(self, condition, order=None):
        """Read what it tells until one line is as wanted; an order is repeated meanwhile."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            if order is not None:
                self.say(order)
            with contextlib.suppress(queue.Empty):
                line = json.loads(self._lines.get(timeout=0.2))
                self.report.append(line)
                if condition(line):
                    return line
        raise AssertionError(f"the HAL's process did not report what was waited for: {list(self.report)[-3:]}")

    def signal(self, number):
        self._process.send_signal(number)

    def close(self):
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._process.stdin.close()
        self._process.stdout.close()


class Stage:
    """A rig in real time on hub channels of its own, and HAL processes that come and go."""

    def __init__(self, folder):
        body = wire_description()
        for name, bus in body["buses"].items():
            bus.update(interface="hub", channel=str(Path(folder) / name))
        body["folder"] = str(body["folder"])
        self._path = Path(folder) / "robot.json"
        self._path.write_text(json.dumps(body))
        self.world = WitnessWorld()
        self.rig = Rig(RobotConfig.model_validate(body), self.world, wire_hardware())
        self.rig.start()
        self.rig.fault("node_silent stray_drive")

    def moving_master(self):
        """A HAL that has enabled the robot and moves it."""
        master = Master(self._path)
        master.until(lambda line: line.get("is_ready"), "reset")
        master.until(lambda line: line.get("mode") == "follow", "enable")
        return master

    def drives_that_run(self):
        return [
            name
            for name in ("biceps_drive", "triceps_drive")
            if self.rig.node(name).state is State.OPERATION_ENABLED
        ]  # fmt: skip

    def wait_for_rest(self, start):
        """When no drive ran any more, and when none had power any more, each [s] after `start`."""
        quick = None
        while time.monotonic() - start < PATIENCE:
            if quick is None and not self.drives_that_run():
                quick = time.monotonic() - start
            if not self.world.enabled:
                return quick, time.monotonic() - start
            time.sleep(0.001)
        return quick, None

    def fastest(self):
        """Highest mean speed [m/s] over a window of the remembered motion."""
        rows = [row[:3] for row in list(self.world.history)]  # the world goes on meanwhile
        return max(
            abs(later[k] - sooner[k]) / max(later[0] - sooner[0], 1e-9)
            for sooner, later in zip(rows, rows[WINDOW:], strict=False)
            for k in (1, 2)
        )


def break_master(outcome, duration):
    """Kill the moving HAL, or freeze it for `duration` [s]; then move again."""
    chance = random.Random(f"{outcome.fault} {outcome.seed}")
    with tempfile.TemporaryDirectory() as folder:
        stage = Stage(folder)
        masters = [stage.moving_master()]
        try:
            time.sleep(chance.uniform(0.1, 0.5))
            masters[0].signal(signal.SIGKILL if duration is None else signal.SIGSTOP)
            _watch(stage, outcome, duration)
            if duration is None:
                masters.append(stage.moving_master())
            else:
                _thaw(stage, masters[0], outcome)
            outcome.recovered = len(stage.world.enabled) == len(DRIVES)
            if stage.fastest() > 0.25 * 1.5:
                outcome.violated["motion"] = f"{stage.fastest():.3f} m/s"
        except AssertionError as error:
            outcome.violated["recovery"] = str(error)[:300]
        finally:
            for master in masters:
                master.close()
            stage.rig.stop()
    return outcome


def _watch(stage, outcome, duration):
    start = time.monotonic()
    outcome.noticed, outcome.stopped = stage.wait_for_rest(start)
    if outcome.stopped is None:
        outcome.violated["power"] = "the drives kept their power"
    rises = len(stage.world.rises)
    time.sleep(max((duration or 1.0) - (time.monotonic() - start), 0.0))
    if len(stage.world.rises) > rises:
        outcome.violated["enabled"] = "a drive was enabled while nobody was there"


def _thaw(stage, master, outcome):
    rises = len(stage.world.rises)
    master.signal(signal.SIGCONT)
    report = [master.until(lambda line: "at" in line) for _ in range(3)]
    ahead = stage.world.time - time.time()
    for line in report:
        if line["tension"] is not None:
            age = line["at"] + ahead - (line["tension"] - 20.0) / TENSION_RAMP
            if age > OLD:
                outcome.violated["stale"] = f"a tension {age:.3f} s old was called valid"
    if not _is_in_fault(master):
        master.until(lambda line: line.get("mode") == "fault")
    time.sleep(0.5)
    if len(stage.world.rises) > rises:
        outcome.violated["enabled"] = "a drive was enabled by itself"
    master.until(lambda line: line.get("is_ready") and line["mode"] == "off", "reset")
    master.until(lambda line: line.get("mode") == "follow", "enable")


def _is_in_fault(master):
    return [line["mode"] for line in master.report if "mode" in line][-1] == "fault"
