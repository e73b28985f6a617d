"""Lateness of the loops of HAL and service, compared with bare timer loops of the same rates at the same time.

    python -m studies.stack.loops --minutes 10 [--without-bus]

The whole stack runs as on a robot: simulated nodes on the hub, HAL, service; a client engages the controller, sends a
new target every second and keeps the online update on. At the same time another process runs bare timer loops at the
same rates with the same scheduling and measures their lateness. Without a bus the arm's physics runs in the HAL's
process, because 25 simulated nodes and their frames cost more than the measured service, and a real robot has no
simulated nodes.
"""

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.table import Table

from hal.config import load_robot
from services.client import Client
from services.hardware.hal_service import CYCLE_PRIORITY
from services.model.gemuco_service import PRIORITIES
from services.process.supervisor import Supervisor, gemuco_command
from services.wire.messages import Status
from studies.bodies.actual_arms import model
from studies.stack.driving import Mover, engage, measures
from studies.stack.processes import BareLoops, cpu

TARGET_EVERY, REACH = 1.0, 0.6


def stack(robot_file: Path, with_bus: bool) -> dict[str, list[str]]:
    """Return process -> its command line."""
    file = str(robot_file)
    if not with_bus:
        hal = [sys.executable, "-m", "studies.stack.in_process", file]
        return {"hal": hal, "serve": gemuco_command("serve", file)}
    return {
        "simulate": gemuco_command("simulate", file, "--variant", "actual", "--seed", "1"),
        "hal": gemuco_command("hal", file),
        "serve": gemuco_command("serve", file),
    }


def run(robot_file: Path, minutes: float, with_bus: bool = True) -> dict[str, Any]:
    """Return loop name -> statistics of the loop and of the bare loop, process -> share of a core."""
    robot = load_robot(robot_file)
    model(robot, Console())
    rates = {name: rate for name, rate in robot.rates.model_dump().items() if name in ("hal", *PRIORITIES)}
    bare = BareLoops({name: (rate, PRIORITIES.get(name, CYCLE_PRIORITY)) for name, rate in rates.items()})
    with Supervisor(Path("runs/loops")) as supervisor, Client(robot.robot) as client:
        pids = {
            name: supervisor.start(name, command).process.pid for name, command in stack(robot_file, with_bus).items()
        }
        supervisor.wait_ready("serve", lambda: measures(client), 60)
        engage(client)
        client.adapt(True)
        time.sleep(3.0)
        with bare:
            used, began = {name: cpu(pid) for name, pid in pids.items()}, time.monotonic()
            before = statuses(client)
            with Mover(client, robot, TARGET_EVERY, REACH) as mover:
                time.sleep(60 * minutes)
                stops = mover.counted["engaged"] + mover.counted["refused"]
            supervisor.check()
            baseline, after = bare.counted(), statuses(client)
            elapsed = time.monotonic() - began
            shares = {name: (cpu(pid) - used[name]) / elapsed for name, pid in pids.items()}
    loops = {}
    for service, status in after.items():
        for name, end in status.loops.items():
            start = before[service].loops[name]
            counted = {key: end[key] - start[key] for key in ("ticks", "skipped", "overruns", "failed")}
            kept = {key: end[key] for key in ("rate_wanted", "total_p50", "total_p99", "total_max")}
            rate = counted["ticks"] / (60 * minutes)
            loops[name] = kept | counted | {"rate": rate, "bare": baseline.get(name, {})}
    facts = {name: status.facts for name, status in after.items()}
    return {"minutes": minutes, "loops": loops, "cores": shares, "stops": stops, "facts": facts}


def statuses(client: Client) -> dict[str, Status]:
    """Return service -> its newest status.

    Raises:
        TimeoutError: A service published no status within 3 s.
    """
    newest = {}
    for name in ("hal", "model"):
        status = client.status(name, timeout=3.0)
        if status is None:
            raise TimeoutError(f"No status of service '{name}' within 3 s. Is it running?")
        newest[name] = status
    return newest


def show(result: dict[str, Any], console: Console) -> None:
    """Print the table of docs/results_running.md; times in ms."""
    table = Table(
        "loop", "rate [Hz]", "p50", "p99", "max", "skipped", "bare p50", "bare p99", "bare max", "bare skipped"
    )
    for name, loop in result["loops"].items():
        bare = loop["bare"]
        late, other = (
            [f"{1e3 * counts[key]:.2f}" if counts else "" for key in ("total_p50", "total_p99", "total_max")]
            for counts in (loop, bare)
        )
        skipped = f"{loop['skipped']:.0f} of {loop['ticks'] + loop['skipped']:.0f}"
        table.add_row(name, f"{loop['rate']:.2f}", *late, skipped, *other, f"{bare.get('skipped', 0):.0f}")
    console.print(table)
    console.print(f"the HAL stopped the arm {result['stops']} times")
    console.print("share of a core: " + ", ".join(f"{name} {share:.0%}" for name, share in result["cores"].items()))
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    console.print(f"largest process: {peak:.0f} MiB")


@contextmanager
def with_rates(robot_file: Path, rates: str) -> Iterator[Path]:
    """Yield a robot file with other rates (`estimation=500,update=20`), in the same folder."""
    if not rates:
        yield robot_file
        return
    described = yaml.safe_load(robot_file.read_text())
    described["rates"] |= {name: float(rate) for name, _, rate in (pair.partition("=") for pair in rates.split(","))}
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", dir=robot_file.parent) as file:
        yaml.safe_dump(described, file)
        file.flush()
        yield Path(file.name)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", type=Path, default=Path("robots/musashi_arm.yaml"))
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--out", type=Path, default=Path("runs/loops.json"))
    parser.add_argument("--rates", default="", help="other rates than the robot file's: estimation=500,update=20")
    parser.add_argument("--without-bus", action="store_true", help="the arm's physics in the HAL's own process")
    options = parser.parse_args()
    with with_rates(options.robot, options.rates) as file:
        result = run(file, options.minutes, not options.without_bus)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1, default=str))
    show(result, Console(width=140))
