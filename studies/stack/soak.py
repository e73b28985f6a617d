"""Endurance of a whole simulated robot that loses a sensor every minute: memory, threads, files, ticks.

    python -m studies.stack.soak --minutes 60

Router, simulator, HAL, model with online update, and recorder of a light robot (six CANopen nodes on a hub bus) run as
processes; this process is the remote client, through the router. The robot is engaged and moves to a random target
every two seconds. Ten seconds after the start of each minute the encoder of one joint goes silent; it returns after
thirty seconds. Once a minute the study reads memory, threads, open files and processor time of every process, and
ticks, skips and lateness of every loop. Bare timer loops with the same rates and priorities measure the skips that the
machine causes. The study ends with verdicts and a JSON file.
"""

import argparse
import contextlib
import json
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from rich.console import Console
from rich.table import Table

from hal.config import load_robot
from services.client import Client
from services.errors import NoAnswer
from services.hardware.hal_service import CYCLE_PRIORITY
from services.model.gemuco_service import PRIORITIES
from services.process.realtime import prepare_process
from services.process.supervisor import Supervisor, gemuco_command
from services.wire import keys
from studies.stack import light_model, light_robot
from studies.stack.arrivals import Arrivals
from studies.stack.driving import PATIENCE, Mover
from studies.stack.processes import BareLoops, look

RATE = 50.0
"""HAL and estimation run at this rate [Hz], which is low because other work runs on the machine too."""
LOST_AT, BACK_AT, MINUTE = 10.0, 40.0, 60.0
TARGET_EVERY, REACH = 2.0, 0.5
READY_WITHIN = 300.0
"""Time [s] for one process to start on a busy machine."""
FILE = "300"
"""Time [s] that one file of the recorder covers; its index stays in memory until then."""
SETTLED = 5
"""Minutes after which memory and threads must not grow."""
GAP = 0.1
"""A longer pause [s] between two estimates counts as a gap at the client."""
MOST_SKIPPED = 1e-4
"""Share of a loop's periods that may be skipped beyond those of the bare loop beside it."""
MOST_GROWTH = 2.0
"""Growth [MB per hour] that counts as flat: an allocator's noise over one hour."""
RECOVERIES = ("until_estimated", "until_measured")


def insist(act: Callable[[], object]) -> int:
    """Call until the service answers, for at least `PATIENCE`; return the number of calls without an answer."""
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


def free_port() -> int:
    """Return a port that is free at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def start(supervisor: Supervisor, client: Client, file: Path, model: Path, router: str, folder: Path) -> None:
    """Start the robot's processes, each when the one before is ready."""
    connect = ("--connect", router)
    commands = {
        "simulator": ("simulate", str(file), *connect),
        "hal": ("hal", str(file), *connect),
        "model": ("serve", str(file), "--model", str(model), *connect),
        "recorder": ("record", str(file), str(folder / "soak.mcap"), "--max-seconds", FILE, *connect),
    }
    for name, command in commands.items():
        supervisor.start(name, gemuco_command(*command))

        def is_running(name: str = name) -> bool:
            status = client.status(name)
            return status is not None and status.state in ("running", "degraded")

        supervisor.wait_ready(name, is_running, READY_WITHIN)


def loops(client: Client) -> dict[str, dict[str, float]]:
    """Return loop -> its statistics; services without a status are left out."""
    statuses = [client.status(service) for service in ("simulator", "hal", "model", "recorder")]
    return {name: loop for status in statuses if status is not None for name, loop in status.loops.items()}


def minute(client: Client, arrivals: Arrivals, joint: str, index: int, until: float) -> dict[str, Any]:
    """Lose a sensor for thirty seconds; return the times [s] until it was estimated, and measured again."""
    begun = until - MINUTE
    time.sleep(max(0.0, begun + LOST_AT - time.monotonic()))
    unanswered = insist(lambda: client.fault(f"sensor_silent {joint}_encoder"))
    lost = arrivals.wait(light_robot.JOINT, index, True, PATIENCE)
    time.sleep(max(0.0, begun + BACK_AT - time.monotonic()))
    unanswered += insist(lambda: client.fault(f"node_back {joint}_encoder"))
    back = arrivals.wait(light_robot.JOINT, index, False, PATIENCE)
    time.sleep(max(0.0, until - time.monotonic()))
    return {"sensor": joint, "until_estimated": lost, "until_measured": back, "unanswered": unanswered}


def run(minutes: int, out: Path) -> dict[str, Any]:
    """Run the robot and write one row per minute into a file."""
    prepare_process()
    folder = out.parent / "soak"
    folder.mkdir(parents=True, exist_ok=True)
    file, model = light_robot.write(folder, f"soak_{os.getpid()}", RATE, True), folder / "model"
    light_model.make(file, model)
    robot, router = load_robot(file), f"tcp/127.0.0.1:{free_port()}"
    priorities = {"hal": CYCLE_PRIORITY, **PRIORITIES}
    rates = {name: rate for name, rate in robot.rates.model_dump().items() if name in priorities}
    bare = BareLoops({name: (rate, priorities[name]) for name, rate in rates.items()})
    result: dict[str, Any] = {"minutes": minutes, "rates": rates, "rows": []}
    with Supervisor(folder) as supervisor:
        supervisor.start("router", gemuco_command("router", "--listen", router))
        with _client(robot.robot, router) as client, bare:
            start(supervisor, client, file, model, router, folder)
            arrivals = Arrivals(GAP)
            subscriber = client.session.declare_subscriber(
                keys.estimate(robot.robot), lambda sample: arrivals.add(msgpack.unpackb(sample.payload.to_bytes()))
            )
            insist(lambda: client.adapt(True))
            pids = {name: child.process.pid for name, child in supervisor.children.items()}
            pids |= {"client": os.getpid(), "bare": bare.pid}
            joints = robot.signals["joint_position"].elements
            with Mover(client, robot, TARGET_EVERY, REACH) as mover:
                begun = time.monotonic()
                for number in range(minutes):
                    index = number % len(joints)
                    row = minute(client, arrivals, joints[index], index, begun + MINUTE * (number + 1))
                    supervisor.check()
                    row |= {
                        "minute": number + 1,
                        "load": os.getloadavg()[0],
                        "processes": {name: look(pid) for name, pid in pids.items()},
                        "loops": loops(client),
                        "bare": bare.counted(),
                        "estimates": arrivals.arrived,
                        "lost": arrivals.lost,
                        "gaps": arrivals.gaps,
                        "longest": arrivals.longest,
                        "mover": dict(mover.counted) | {"last_refusal": mover.last_refusal},
                    }
                    result["rows"].append(row)
                    out.write_text(json.dumps(result, indent=1))
            subscriber.undeclare()
    return result


def _client(robot: str, router: str) -> Client:
    """Return a client of a router that may still be starting."""
    deadline = time.monotonic() + READY_WITHIN
    while True:
        address = ("127.0.0.1", int(router.rpartition(":")[2]))
        with contextlib.suppress(OSError), socket.create_connection(address, 1.0):
            return Client(robot, (router,), name="soak")
        if time.monotonic() > deadline:
            raise TimeoutError(f"No router at {router} within {READY_WITHIN:g} s.")
        time.sleep(0.1)


def judge(result: dict[str, Any], console: Console) -> bool:
    """Print the verdicts; return whether all of them are good."""
    rows = result["rows"]
    is_good = all([_judge_processes(rows, console), _judge_loops(rows, console)])
    for event in RECOVERIES:
        times = np.array([row[event] for row in rows])
        recovered = times[np.isfinite(times)]
        is_good &= len(recovered) == len(times)
        console.print(
            f"{event}: median {np.median(recovered):.3f} s, worst {recovered.max():.3f} s, "
            f"{len(times) - len(recovered)} of {len(times)} never"
        )
    last = rows[-1]
    console.print(
        f"at the client: {last['estimates']} estimates, {last['lost']} lost, {last['gaps']} gaps, longest pause "
        f"{last['longest']:.3f} s; mover: {last['mover']}"
    )
    return is_good


def _judge_processes(rows: list[dict[str, Any]], console: Console) -> bool:
    """Print memory, threads and files of every process; return whether all are flat after the first minutes."""
    settled = rows[SETTLED:] if len(rows) > SETTLED + 1 else rows
    hours = np.array([row["minute"] for row in settled], float) / 60.0
    table = Table("process", "MB at first", "MB at last", "MB/h", "threads", "files", "% of a core", "flat")
    is_good = True
    for name in rows[0]["processes"]:
        states = [row["processes"][name] for row in settled]
        memory = [state["rss"] for state in states]
        slope = float(np.polyfit(hours, memory, 1)[0]) if len(hours) > 1 else float("nan")
        threads, files = ([int(state[kind]) for state in states] for kind in ("threads", "files"))
        is_flat = slope < MOST_GROWTH and not _creeps(threads) and not _creeps(files)
        is_good &= is_flat
        core = (states[-1]["cpu"] - states[0]["cpu"]) / max(3600.0 * (hours[-1] - hours[0]), 1.0)
        ends = [f"{row['processes'][name]['rss']:.1f}" for row in (rows[0], rows[-1])]
        spans = [f"{min(counts)} to {max(counts)}" for counts in (threads, files)]
        table.add_row(name, *ends, f"{slope:.2f}", *spans, f"{100 * core:.0f}", "yes" if is_flat else "NO")
    console.print(table)
    return is_good


def _creeps(counts: list[int]) -> bool:
    """Whether the last third needs more than the first: zenoh and Python start and end threads all the time."""
    third = max(1, len(counts) // 3)
    return max(counts[-third:]) > max(counts[:third]) + 1


def _judge_loops(rows: list[dict[str, Any]], console: Console) -> bool:
    """Print the skips of every loop beside those of the bare loop with the same rate, since the first minute."""
    table = Table("loop", "rate kept [Hz]", "skipped", "bare skipped", "late p99 [ms]", "failed")
    is_good, span = True, 60.0 * (rows[-1]["minute"] - rows[0]["minute"])
    for name, last in rows[-1]["loops"].items():
        first = rows[0]["loops"].get(name)
        if first is None or span == 0.0:
            continue
        counted = {kind: last[kind] - first[kind] for kind in ("ticks", "skipped", "failed")}
        is_good &= counted["failed"] == 0
        other = ""
        if name in rows[-1]["bare"]:
            bare = rows[-1]["bare"][name]["skipped"] - rows[0]["bare"][name]["skipped"]
            is_good &= counted["skipped"] <= bare + MOST_SKIPPED * counted["ticks"]
            other = f"{bare:.0f}"
        row = (f"{counted['ticks'] / span:.2f}", f"{counted['skipped']:.0f}", other, f"{1e3 * last['total_p99']:.2f}")
        table.add_row(name, *row, f"{counted['failed']:.0f}")
    console.print(table)
    return is_good


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path("runs/soak.json"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    terminal = Console(width=140)
    verdict = "ALL FLAT" if judge(run(options.minutes, options.out), terminal) else "NOT ALL FLAT"
    terminal.print(verdict, f"over {options.minutes} minutes; {options.out}")
