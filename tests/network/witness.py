"""Runs a service as `gemuco` does, and writes down beside it what is true, on clocks of its own.

The HAL's witness stands between the service and the robot: when each cycle began, what was followed, and which cycle
the command answers. The model's witness looks at each estimate when it was made. Both write to a file that survives
kill -9. The wall clock of the service, but not its monotonic one, is moved by the number [s] in a file.

    python witness.py hal|model|simulator FILE.yaml RECORD CLOCK [MODEL] [CONNECT ...]
"""

import logging
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import msgpack
import numpy as np

from hal.clock import SystemClock
from hal.config import load_robot
from hal.robot import Robot, open_robot

REAL_NS = time.time_ns


class HalWitness:
    """A robot as the HAL's service sees it."""

    def __init__(self, robot: Robot, record: BinaryIO) -> None:
        self._robot, self._record = robot, record
        self._began: dict[int, float] = {}
        self._accepted: list[tuple[np.ndarray, int]] = []
        self._number = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._robot, name)

    def command(self, desired: np.ndarray, cycle: int) -> None:
        self._robot.command(desired, cycle)
        self._accepted = [*self._accepted[-7:], (np.array(desired, float), cycle)]

    def cycle(self) -> Any:
        """One turn: what is followed in it must be a command that was seen to be accepted."""
        began = time.monotonic()
        sample, applied = self._robot.cycle()
        self._began[sample.cycle] = began
        self._began.pop(sample.cycle - 5000, None)
        answers, age = -1, math.nan
        if np.isfinite(applied.desired).any():
            same = [cycle for desired, cycle in self._accepted if np.array_equal(desired, applied.desired)]
            answers = same[-1] if same else 0
            age = began - self._began.get(answers, -math.inf)
        self._record.write(
            msgpack.packb([began, sample.cycle, applied.mode, answers, age, applied.values.tolist(), sample.stamp_ns])
        )
        stamp_ns = sample.stamp_ns + time.time_ns() - REAL_NS()
        return replace(sample, stamp_ns=stamp_ns), replace(applied, stamp_ns=stamp_ns)


def run_hal(file: Path, record: BinaryIO, connect: list[str]) -> int:
    from services.hardware import hal_service

    return hal_service.run_hal(load_robot(file), connect, make=lambda config: HalWitness(open_robot(config), record))  # type: ignore


def run_model(file: Path, record: BinaryIO, folder: Path, connect: list[str]) -> int:
    from services.model import serve
    from services.model.estimation import Estimation

    tick = Estimation.tick

    def witnessed(self: Estimation) -> None:
        began = time.monotonic()
        tick(self)
        found = self.latest
        if found is not None:
            record.write(msgpack.packb([began, found.cycle, found.method]))

    SystemClock.now_ns = staticmethod(time.time_ns)  # type: ignore[method-assign]
    Estimation.tick = witnessed  # type: ignore[method-assign]
    serve.serve(load_robot(file), folder, connect)
    return 0


def run_simulator(file: Path, connect: list[str]) -> int:
    from services.hardware import simulator_service

    return simulator_service.run_simulator(load_robot(file), "plain", 0, None, connect)


def move_wall_clock(file: Path) -> None:
    """Let `time.time` and `time.time_ns` of this process be off by the number [s] in a file, read ten times a second.

    The HAL's bus keeps its own: the frames' stamps come from the kernel, or here from the simulator's process, which
    would have to be set in the same instant.
    """
    real, real_ns = time.time, time.time_ns
    state = [0.0, 0.0]

    def offset() -> float:
        now = time.monotonic()
        if now >= state[1]:
            state[1] = now + 0.1
            try:
                state[0] = float(file.read_text())
            except (OSError, ValueError):
                state[0] = 0.0
        return state[0]

    time.time = lambda: real() + offset()
    time.time_ns = lambda: real_ns() + round(1e9 * offset())


def main(service: str, file: str, record: str, clock: str, *rest: str) -> int:
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    if clock:
        move_wall_clock(Path(clock))
    if service == "simulator":
        return run_simulator(Path(file), list(rest))
    with Path(record).open("ab", buffering=0) as sink:
        if service == "hal":
            return run_hal(Path(file), sink, list(rest))
        return run_model(Path(file), sink, Path(rest[0]), list(rest[1:]))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
