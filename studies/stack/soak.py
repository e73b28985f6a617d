"""Nothing grows and nothing is left behind: an hour of a whole simulated robot that loses a sensor every minute.

    python -m studies.stack.soak --minutes 60

Router, simulator, HAL, model with online update, and recorder of a light robot (six CANopen nodes on a hub bus) run as
processes; this one is the remote client, through the router. The robot is engaged and moves to a random target every
two seconds. Ten seconds into each minute one joint's encoder falls silent, thirty seconds later it comes back. Once a
minute memory, threads, open files and processor time of every process are read, and every loop's ticks, skips and
lateness; a process of bare timer loops with the same rates and priorities tells what the machine itself skipped
meanwhile. Ends with verdicts and a JSON file.
"""

import argparse
import contextlib
import json
import os
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zenoh
from rich.console import Console
from rich.table import Table

from hal.config import RobotConfig, load_robot
from hal.errors import HalError
from services.client import Client
from services.errors import NoAnswer, ServiceError
from services.hardware.hal_service import CYCLE_PRIORITY
from services.model.gemuco_service import PRIORITIES
from services.process.realtime import prepare_process
from services.process.supervisor import Supervisor, gemuco_command
from services.wire import keys
from studies.stack import light_robot
from studies.stack.processes import BareLoops, look

RATE = 50.0
"""Of HAL and estimation [Hz]; modest, since others work on this machine too."""
LOST_AT, BACK_AT, MINUTE = 10.0, 40.0, 60.0
TARGET_EVERY, REACH = 2.0, 0.5
PATIENCE = 15.0
READY_WITHIN = 300.0
"""Of one process [s]; a machine that others use in real time gives little to a program that starts."""
FILE = "300"
"""What one file of the recorder covers [s]; its index is in memory until then."""
SETTLED = 5
"""Minutes after which memory and threads must not grow."""
GAP = 0.1
"""An estimate that comes so much [s] after the one before is a gap at the client."""
MOST_SKIPPED = 1e-4
"""Part of a loop's periods that may be skipped beyond what the bare loop beside it skips."""
MOST_GROWTH = 2.0
"""MB per hour that count as flat: an allocator's noise over one hour."""


class Arrivals:
    """Counts the estimates that reach this process, and looks at one element."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self.counted = {"estimates": 0, "lost": 0, "gaps": 0, "longest": 0.0, "latency": 0.0}
        self._news = threading.Condition()
        self._before: tuple[int, int, float] | None = None
        self._is_estimated = np.zeros(len(light_robot.JOINTS), bool)
        self._subscriber = session.declare_subscriber(keys.estimate(robot), self._receive)

    def take(self) -> dict[str, float]:
        """What was counted since the last call."""
        found, self.counted = self.counted, dict.fromkeys(self.counted, 0)
        return found

    def wait(self, joint: int, is_estimated: bool) -> float:
        """How long [s] until this joint is estimated, or measured; NaN if that takes longer than `PATIENCE`."""
        begun = time.monotonic()
        with self._news:
            if not self._news.wait_for(lambda: self._is_estimated[joint] == is_estimated, PATIENCE):
                return float("nan")
        return time.monotonic() - begun

    def _receive(self, sample: zenoh.Sample) -> None:
        now, body = time.monotonic(), msgpack.unpackb(sample.payload.to_bytes())
        seq, boot = body["seq"], body["boot"]
        counted = self.counted
        counted["estimates"] += 1
        counted["latency"] = max(counted["latency"], (time.time_ns() - body["stamp_ns"]) * 1e-9)
        if self._before is not None and self._before[1] == boot:
            counted["lost"] += seq - self._before[0] - 1
            pause = now - self._before[2]
            counted["gaps"] += pause > GAP
            counted["longest"] = max(counted["longest"], pause)
        self._before = (seq, boot, now)
        with self._news:
            self._is_estimated = np.frombuffer(body["estimated"]["joint_position"], "?")
            self._news.notify_all()


class Mover:
    """Keeps the arm engaged and gives it targets, in a thread; what it was refused is counted."""

    def __init__(self, client: Client, robot: RobotConfig) -> None:
        self.counted = {"targets": 0, "engaged": 0, "refused": 0}
        self.last_refusal = ""
        self._client = client
        self._low, self._high = robot.bounds("joint_position")
        self._random = np.random.default_rng(0)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mover", daemon=True)

    def __enter__(self) -> "Mover":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        with contextlib.suppress(ServiceError, HalError):
            self._client.disengage()
            self._client.stop()

    def _run(self) -> None:
        while not self._stop.wait(TARGET_EVERY):
            try:
                self._turn()
            except (ServiceError, HalError) as error:
                self.counted["refused"] += 1
                self.last_refusal = str(error)

    def _turn(self) -> None:
        applied = self._client.applied(timeout=1.0)
        if applied is None or applied.mode not in ("follow", "hold", "enabling"):
            if applied is not None and applied.mode == "fault":
                self._client.reset()
            self.counted["engaged"] += 1
            self._client.engage()
        middle, half = (self._low + self._high) / 2, (self._high - self._low) / 2
        self._client.target("joint_position", middle + REACH * half * self._random.uniform(-1, 1, middle.size))
        self.counted["targets"] += 1


def insist(act: Callable[[], object]) -> int:
    """Ask until it is answered, for `PATIENCE` at least; how often it was not."""
    deadline, refused = time.monotonic() + PATIENCE, 0
    while True:
        try:
            act()
        except NoAnswer:
            refused += 1
            if time.monotonic() > deadline:
                return refused
        else:
            return refused


def free_port() -> int:
    """A port that nobody listens on at the moment."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def start(supervisor: Supervisor, client: Client, file: Path, model: Path, where: str, folder: Path) -> None:
    """Start the robot's processes, each when the one before is ready."""
    connect = ("--connect", where)
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
    """Loop -> its statistics; nothing of a service whose status does not come."""
    found: dict[str, dict[str, float]] = {}
    for service in ("simulator", "hal", "model", "recorder"):
        status = client.status(service)
        found |= status.loops if status is not None else {}
    return found


def minute(client: Client, arrivals: Arrivals, joint: str, index: int, until: float) -> dict[str, Any]:
    """One minute: the sensor lost and back; how long it took to be estimated, and measured again [s]."""
    begun = until - MINUTE
    time.sleep(max(0.0, begun + LOST_AT - time.monotonic()))
    refused = insist(lambda: client.fault(f"sensor_silent {joint}_encoder"))
    lost = arrivals.wait(index, True)
    time.sleep(max(0.0, begun + BACK_AT - time.monotonic()))
    refused += insist(lambda: client.fault(f"node_back {joint}_encoder"))
    back = arrivals.wait(index, False)
    time.sleep(max(0.0, until - time.monotonic()))
    return {"sensor": joint, "until_estimated": lost, "until_measured": back, "refused": refused}


def run(minutes: int, out: Path) -> dict[str, Any]:
    """The whole soak; one row per minute, written to `out` as they come."""
    prepare_process()
    folder = out.parent / "soak"
    folder.mkdir(parents=True, exist_ok=True)
    file, model = light_robot.write(folder, f"soak_{os.getpid()}", RATE, True), folder / "model"
    light_robot.make_model(file, model)
    robot, where = load_robot(file), f"tcp/127.0.0.1:{free_port()}"
    priorities = {"hal": CYCLE_PRIORITY, **PRIORITIES}
    rates = {name: rate for name, rate in robot.rates.model_dump().items() if name in priorities}
    bare = BareLoops({name: (rate, priorities[name]) for name, rate in rates.items()})
    found: dict[str, Any] = {"minutes": minutes, "rates": rates, "rows": []}
    with Supervisor(folder) as supervisor:
        supervisor.start("router", gemuco_command("router", "--listen", where))
        with _client(robot.robot, where) as client, bare:
            start(supervisor, client, file, model, where, folder)
            arrivals = Arrivals(client.session, robot.robot)
            insist(lambda: client.adapt(True))
            pids = {name: child.process.pid for name, child in supervisor.children.items()}
            pids |= {"client": os.getpid(), "bare": bare.pid}
            joints = robot.signals["joint_position"].elements
            with Mover(client, robot) as mover:
                begun = time.monotonic()
                for number in range(minutes):
                    which = number % len(joints)
                    row = minute(client, arrivals, joints[which], which, begun + MINUTE * (number + 1))
                    supervisor.check()
                    row |= {
                        "minute": number + 1,
                        "load": os.getloadavg()[0],
                        "processes": {name: look(pid) for name, pid in pids.items()},
                        "loops": loops(client),
                        "bare": bare.counted(),
                        "client": arrivals.take(),
                        "mover": dict(mover.counted) | {"last_refusal": mover.last_refusal},
                    }
                    found["rows"].append(row)
                    out.write_text(json.dumps(found, indent=1))
    return found


def _client(robot: str, where: str) -> Client:
    """A client of the router; it may be starting still."""
    deadline = time.monotonic() + READY_WITHIN
    while True:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", int(where.rpartition(":")[2])), 1.0):
            return Client(robot, (where,), name="soak")
        if time.monotonic() > deadline:
            raise TimeoutError(f"No router at {where} within {READY_WITHIN:g} s.")
        time.sleep(0.1)


def growth(minutes: np.ndarray, values: np.ndarray) -> float:
    """Least-squares slope [per hour] of a value that was read at these minutes."""
    return float(np.polyfit(minutes / 60.0, values, 1)[0]) if len(minutes) > 1 else float("nan")


def judge(found: dict[str, Any], console: Console) -> bool:
    """Print the verdicts; whether all of them are good."""
    rows = found["rows"]
    settled = rows[SETTLED:] if len(rows) > SETTLED + 1 else rows
    minutes = np.array([row["minute"] for row in settled], float)
    table = Table("process", "MB at first", "MB at last", "MB/h", "threads", "files", "% of a core", "flat")
    good = True
    for name in rows[0]["processes"]:
        seen = [row["processes"][name] for row in settled]
        slope = growth(minutes, np.array([one["rss"] for one in seen]))
        threads, files = ({int(one[what]) for one in seen} for what in ("threads", "files"))
        is_flat = slope < MOST_GROWTH and not any(_creeps([one[what] for one in seen]) for what in ("threads", "files"))
        good &= is_flat
        core = (seen[-1]["cpu"] - seen[0]["cpu"]) / max(60.0 * (minutes[-1] - minutes[0]), 1.0)
        ends = [f"{rows[which]['processes'][name]['rss']:.1f}" for which in (0, -1)]
        spans = [" to ".join(map(str, sorted({min(one), max(one)}))) for one in (threads, files)]
        table.add_row(name, *ends, f"{slope:.2f}", *spans, f"{100 * core:.0f}", "yes" if is_flat else "NO")
    console.print(table)
    good &= _judge_loops(rows, console)
    times = {what: np.array([row[what] for row in rows]) for what in ("until_estimated", "until_measured")}
    for what, values in times.items():
        never = int(np.isnan(values).sum())
        good &= never == 0
        kept = values[np.isfinite(values)]
        console.print(
            f"{what}: median {np.median(kept):.3f} s, worst {kept.max():.3f} s, never {never} of {len(values)}"
        )
    sums = {what: sum(row["client"][what] for row in rows) for what in ("estimates", "lost", "gaps")}
    longest = max(row["client"]["longest"] for row in rows)
    console.print(f"at the client: {sums}, longest pause {longest:.3f} s; mover: {rows[-1]['mover']}")
    return good


def _creeps(counts: list[float]) -> bool:
    """Whether more of them are needed at the end than at first: zenoh and Python start and end threads all the time."""
    third = max(1, len(counts) // 3)
    return max(counts[-third:]) > max(counts[:third]) + 1


def _judge_loops(rows: list[dict[str, Any]], console: Console) -> bool:
    """Skips of every loop beside those of the bare one with the same rate and priority, since the first minute."""
    table = Table("loop", "rate kept [Hz]", "skipped", "bare skipped", "late p99 [ms]", "failed")
    good, span = True, 60.0 * (rows[-1]["minute"] - rows[0]["minute"])
    for name in rows[-1]["loops"]:
        first, last = rows[0]["loops"].get(name, {}), rows[-1]["loops"][name]
        if not first or span == 0.0:
            continue
        counted = {what: last[what] - first[what] for what in ("ticks", "skipped", "failed")}
        good &= counted["failed"] == 0
        other = ""
        if name in rows[-1]["bare"]:
            bare = rows[-1]["bare"][name]["skipped"] - rows[0]["bare"][name]["skipped"]
            good &= counted["skipped"] <= bare + MOST_SKIPPED * counted["ticks"]
            other = f"{bare:.0f}"
        row = (f"{counted['ticks'] / span:.2f}", f"{counted['skipped']:.0f}", other, f"{1e3 * last['total_p99']:.2f}")
        table.add_row(name, *row, f"{counted['failed']:.0f}")
    console.print(table)
    return good


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path("runs/soak.json"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    result = run(options.minutes, options.out)
    terminal = Console(width=140)
    is_good = judge(result, terminal)
    terminal.print("ALL FLAT" if is_good else "NOT ALL FLAT", f"over {options.minutes} minutes; {options.out}")
