"""How large the messages of a robot are, and what they come to per second at its robot file's rates.

    python -m studies.stack.message_sizes robots/musashi_arm.yaml

Nothing runs: one message of each type is made with all the elements of the robot file, encoded, and decoded again.
"""

import argparse
import time
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
"""How many loops a status tells of."""


def sizes(robot: RobotConfig) -> dict[str, tuple[int, float, float]]:
    """Key -> bytes of a message, messages per second, processor time [s] to decode one."""
    size = {name: signal.size for name, signal in robot.signals.items()}
    floats, truths = {n: np.ones(k) for n, k in size.items()}, {n: np.ones(k, bool) for n, k in size.items()}
    command, words = robot.command.signal, dict.fromkeys(size, "measured")
    stamp = {"stamp_ns": BIG, "seq": 2**30, "boot": BIG}
    cycle, rates = 2**30, robot.rates
    n = size[command]
    anomaly = messages.Anomaly(
        cycle=cycle, score=1.0, threshold=1.0, is_anomaly=False, blamed="muscle_length.biceps", contribution=floats,
        verdict="normal",
    )  # fmt: skip
    found: dict[str, tuple[messages.Message, float]] = {
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
        keys.anomaly("*"): (anomaly, rates.anomaly),
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
        found[keys.status("*", service)] = (status, 1.0)
    encoded = {key: (messages.encode(message, **stamp), rate) for key, (message, rate) in found.items()}
    return {key: (len(data), rate, _decoding(data)) for key, (data, rate) in encoded.items()}


def _decoding(data: bytes) -> float:
    """Processor time [s] that one message costs who reads it; the least of several tries."""
    tries = []
    for _ in range(5):
        begun = time.process_time()
        for _ in range(TIMES):
            messages.decode_any(data)
        tries.append((time.process_time() - begun) / TIMES)
    return min(tries)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", type=Path, nargs="*", default=sorted(Path("robots").glob("*_*.yaml")))
    for path in parser.parse_args().robot:
        made = sizes(load_robot(path))
        table = Table("key", "bytes", "per second", "kB/s", "decoding us", title=path.stem)
        for name, (length, often, costs) in made.items():
            table.add_row(name, f"{length}", f"{often:g}", f"{length * often / 1e3:.1f}", f"{1e6 * costs:.1f}")
        total = sum(length * often for length, often, _ in made.values())
        slow = sum(length * often for length, often, _ in made.values() if often <= 1.0)
        cores = sum(often * costs for _, often, costs in made.values())
        table.add_row(
            "all",
            "",
            f"{sum(often for _, often, _ in made.values()):g}",
            f"{total / 1e3:.1f}",
            f"{100 * cores:.2f} % of a core",
        )
        table.add_row("what `gemuco top` hears", "", "", f"{slow / 1e3:.1f}")
        Console(width=100).print(table)
