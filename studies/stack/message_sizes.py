"""Sizes of a robot's messages, and their sums per second at its robot file's rates.

    python -m studies.stack.message_sizes robots/musashi_arm.yaml

No process runs: one message of each type is made with all elements of the robot file, encoded, and decoded again.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from hal.config import RobotConfig, load_robot
from services.process.lateness import Lateness
from services.wire import keys, messages

BIG = 2**52
TIMES = 300
LOOPS = {"hal": 1, "model": 4}
"""Number of loops in a service's status."""
COLUMNS = ("key", "bytes", "per second", "kB/s", "encoding us", "decoding us")


def examples(robot: RobotConfig) -> dict[str, tuple[messages.Message, float]]:
    """Return key -> a message with all elements, messages per second."""
    size = {name: signal.size for name, signal in robot.signals.items()}
    floats, truths = {n: np.ones(k) for n, k in size.items()}, {n: np.ones(k, bool) for n, k in size.items()}
    command, words = robot.command.signal, dict.fromkeys(size, "measured")
    cycle, rates = 2**30, robot.rates
    n = size[command]
    made: dict[str, tuple[messages.Message, float]] = {
        keys.sample("*"): (
            messages.Sample(cycle=cycle, source="can", complete=True, values=floats, age=floats, valid=truths),
            rates.hal,
        ),
        keys.applied("*"): (
            messages.Applied(cycle=cycle, mode="follow", signal=command, desired=np.ones(n), values=np.ones(n),
                             limited_by=["rate"], sender=BIG), rates.hal,
        ),
        keys.estimate("*"): (
            messages.Estimates(cycle=cycle, values=floats, estimated=truths, std=floats, method=words, mask=words,
                               residual=dict.fromkeys(size, 1.0)), rates.estimation,
        ),
        keys.anomaly("*"): (
            messages.Anomaly(cycle=cycle, score=1.0, threshold=1.0, is_anomaly=False, blamed="muscle_length.biceps",
                             contribution=floats, verdict="normal"), rates.anomaly,
        ),
        keys.update("*"): (
            messages.Update(active=True, model_version=9, window=500, dropped=0, loss=0.1, bias=np.ones(2)),
            rates.update,
        ),
        keys.holder("*"): (messages.Holder(name="anna@workstation (pid 4711)", holder=BIG, left=3.0), 1.0),
    }  # fmt: skip
    loop = {"rate_wanted": 1.0, "rate": 1.0, "busy": 0.1, **Lateness(1).recent(), **Lateness(1).total()}
    loop |= dict.fromkeys(("ticks", "overruns", "skipped", "failed"), 1e6)
    device = {"state": "ready", "text": "", "counters": {"malformed": 0, "missed": 0, "emergencies": 0, "reboots": 0}}
    for service, count in LOOPS.items():
        facts = {"mode": "follow", "devices": dict.fromkeys(robot.devices, device) if service == "hal" else {}}
        status = messages.Status(
            service=service, state="running", loops={f"loop{index}": loop for index in range(count)}, facts=facts
        )
        made[keys.status("*", service)] = (status, 1.0)
    return made


def cost(act: Callable[[], object]) -> float:
    """Return the processor time [us] of one call, the least of several tries."""
    tries = []
    for _ in range(5):
        begun = time.process_time()
        for _ in range(TIMES):
            act()
        tries.append(1e6 * (time.process_time() - begun) / TIMES)
    return min(tries)


def table(robot: RobotConfig) -> Table:
    """Measure the messages of one robot."""
    lines = Table(*COLUMNS, title=robot.robot)
    stamp = {"stamp_ns": BIG, "seq": 2**30, "boot": BIG}
    often = total = slow = cores = 0.0
    for key, (message, rate) in examples(robot).items():
        data = messages.encode(message, **stamp)
        encoding = cost(partial(messages.encode, message, **stamp))
        decoding = cost(partial(messages.decode_any, data))
        lines.add_row(
            key, f"{len(data)}", f"{rate:g}", f"{len(data) * rate / 1e3:.1f}", f"{encoding:.1f}", f"{decoding:.1f}"
        )
        often, total, cores = often + rate, total + len(data) * rate, cores + 1e-6 * rate * decoding
        slow += len(data) * rate if rate <= 1.0 else 0.0
    lines.add_row("all", "", f"{often:g}", f"{total / 1e3:.1f}", "", f"{100 * cores:.2f} % of a core")
    lines.add_row("read by `gemuco top`", "", "", f"{slow / 1e3:.1f}")
    return lines


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", type=Path, nargs="*", default=sorted(Path("robots").glob("*_*.yaml")))
    for path in parser.parse_args().robot:
        Console(width=110).print(table(load_robot(path)))
