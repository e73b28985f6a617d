"""A HAL in a process of its own, to be killed and frozen: cycles in real time, obeys lines on stdin, tells on stdout.

    python tests/hal/master.py robot.json

Lines in: `enable`, `reset`, `quit`. Lines out: JSON, one for each change of mode, and one with the tension of the first
cell, and the wall-clock time of its SYNC, for each of the first cycles after a pause.
"""

import json
import queue
import sys
import threading
import time
from pathlib import Path

import numpy as np

from hal.config import RobotConfig
from hal.errors import CommandRefused
from hal.robot import open_robot

PAUSE = 0.2
"""A cycle later than this [s] is one after a pause."""
TOLD = 5
"""Cycles after a pause whose tension is told."""
REST = np.array([0.30, 0.25])


def tell(**what):
    print(json.dumps(what), flush=True)


def run(robot, lines):
    """Cycle until told to quit."""
    mode, to_tell = "", 0
    due = last = time.monotonic()
    while True:
        sample, applied = robot.cycle()
        now = time.monotonic()
        if now - last > PAUSE:
            to_tell = TOLD
        last = now
        if to_tell:
            to_tell -= 1
            tension = float(sample.values["muscle_tension"][0])
            tell(tension=tension if np.isfinite(tension) else None, at=sample.stamp_ns * 1e-9)
        state = f"{applied.mode}{' ready' if _is_ready(robot, sample) else ''}"
        if state != mode:
            mode = state
            tell(mode=applied.mode, is_ready=state.endswith("ready"), text=robot.fault_text)
        try:
            if applied.mode in ("hold", "follow"):
                robot.command(REST + 0.02 * np.sin(3.0 * now), sample.cycle)
            order = lines.get_nowait()
            if order == "quit":
                return
            {"enable": robot.enable, "reset": robot.reset}[order]()
        except CommandRefused as error:
            tell(refused=str(error))
        except queue.Empty:
            pass
        due = max(due + robot.period, time.monotonic())
        time.sleep(max(due - time.monotonic(), 0.0))


def _listen(lines):
    """Orders until the parent is gone; then quit."""
    for line in sys.stdin:
        lines.put(line.strip())
    lines.put("quit")


def _is_ready(robot, sample):
    return sample.complete and {device["state"] for device in robot.health()["devices"].values()} == {"ready"}


def main(path):
    """Run the robot of a description."""
    robot = open_robot(RobotConfig.model_validate(json.loads(Path(path).read_text())))
    lines = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(lines,), daemon=True).start()
    with robot:
        run(robot, lines)


if __name__ == "__main__":
    main(sys.argv[1])
