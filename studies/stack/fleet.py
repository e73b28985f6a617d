"""Many robots through one router: what each costs, whether every estimate arrives, and what one robot does to others.

    python -m studies.stack.fleet

Light robots (two joints, three signals; HAL service and model service as in life, in one process each, without a bus,
forked from one that has the program loaded) join one after the other until there are 1, 2, 5, 10 and 20. One router
process; this process is the remote client. One of its sessions subscribes to everything, `gemuco/**`, a second one to
the estimates only. Per number of robots: the estimates that arrive, how old the measurement in them is when they do,
gaps, and processor time and memory of robots, router and client; a bare timer loop with the rate and priority of the
estimation tells what the machine adds. Then one robot is killed, and another floods the network as fast as it can.
"""

import argparse
import json
import multiprocessing
import os
import signal
import time
from collections import OrderedDict, defaultdict
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zenoh
from rich.console import Console
from rich.table import Table

from services.model.gemuco_service import PRIORITIES
from services.process.realtime import prepare_process, promote_rest
from services.process.supervisor import Supervisor, gemuco_command
from services.wire import keys
from services.wire.session import CLIENT, close_session, open_session
from studies.stack import light_robot
from studies.stack.fleet_robot import main
from studies.stack.processes import BareLoops, look
from studies.stack.soak import free_port

NUMBERS = (1, 2, 5, 10, 20)
RATE = 20.0
"""Of HAL and estimation [Hz]."""
SETTLE, SPAN = 4.0, 20.0
"""Seconds to wait after all are there, and to count."""
GAP = 0.25
"""An estimate that comes so much [s] after the one before is a gap; five periods."""
CYCLES = 64
"""Cycles of a robot whose stamps are kept, to find the measurement that an estimate was made from."""
CLIENT_PRIORITY = 20
READY_WITHIN = 400.0


class Ear:
    """One session of the remote client: counts what it hears on a key expression."""

    def __init__(self, where: str, expression: str) -> None:
        self._session = open_session("fleet", CLIENT, (where,))
        self._stamps: dict[str, OrderedDict[int, int]] = defaultdict(OrderedDict)
        self._last: dict[str, tuple[int, int, float]] = {}
        self.forget()
        self._subscriber = self._session.declare_subscriber(expression, self._hear)

    def close(self) -> None:
        """Leave the network."""
        close_session(self._session)

    def forget(self) -> None:
        """Begin to count anew."""
        self.begun = time.monotonic()
        self._last.clear()  # a gap before is not counted
        self.sizes: dict[str, list[int]] = defaultdict(lambda: [0, 0])
        self.arrived: dict[str, int] = defaultdict(int)
        self.lost: dict[str, int] = defaultdict(int)
        self.pauses: dict[str, float] = defaultdict(float)
        self.gaps: dict[str, int] = defaultdict(int)
        self.latency: dict[str, list[float]] = defaultdict(list)

    def _hear(self, sample: zenoh.Sample) -> None:
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        robot, service, noun = keys.parse(key)
        size = self.sizes[f"{service}/{noun}"]
        size[0] += 1
        size[1] += len(payload)
        if noun not in ("sample", "estimate") or service not in ("hal", "model"):
            return
        body = msgpack.unpackb(payload)
        if service == "hal":
            stamps = self._stamps[robot]
            stamps[body["cycle"]] = body["stamp_ns"]
            if len(stamps) > CYCLES:
                stamps.popitem(last=False)
            return
        self._estimate(robot, body)

    def _estimate(self, robot: str, body: dict[str, Any]) -> None:
        now = time.monotonic()
        self.arrived[robot] += 1
        measured = self._stamps[robot].get(body["cycle"])
        if measured is not None:
            self.latency[robot].append((time.time_ns() - measured) * 1e-9)
        before = self._last.get(robot)
        if before is not None and before[1] == body["boot"]:
            self.lost[robot] += body["seq"] - before[0] - 1
            pause = now - before[2]
            self.gaps[robot] += pause > GAP
            self.pauses[robot] = max(self.pauses[robot], pause)
        self._last[robot] = (body["seq"], body["boot"], now)

    def summary(self, robots: list[str]) -> dict[str, Any]:
        """What was heard of these robots since the last `forget`."""
        elapsed = time.monotonic() - self.begun
        latency = np.concatenate([np.array(self.latency[robot]) for robot in robots] or [np.zeros(0)])
        p50, p99 = np.quantile(latency, (0.5, 0.99)) if len(latency) else (np.nan, np.nan)
        rates = [self.arrived[robot] / elapsed for robot in robots]
        return {
            "rate_least": min(rates),
            "rate_mean": float(np.mean(rates)),
            "arrived": sum(self.arrived[robot] for robot in robots),
            "lost": sum(self.lost[robot] for robot in robots),
            "gaps": sum(self.gaps[robot] for robot in robots),
            "longest_pause": max((self.pauses[robot] for robot in robots), default=0.0),
            "latency_p50": float(p50),
            "latency_p99": float(p99),
            "bytes_per_s": {key: size / elapsed for key, (_, size) in self.sizes.items()},
            "messages_per_s": {key: count / elapsed for key, (count, _) in self.sizes.items()},
        }


class Fleet:
    """The robots' processes."""

    def __init__(self, folder: Path, where: str) -> None:
        self.processes: dict[str, BaseProcess] = {}
        self._start = multiprocessing.get_context("forkserver")
        self._start.set_forkserver_preload(["studies.stack.fleet_robot"])
        self._folder, self._where, self._model = folder, where, folder / "model"
        light_robot.make_model(light_robot.write(folder, "fleet_any", RATE, False), self._model)

    def grow(self, number: int) -> list[str]:
        """Start robots until there are so many; their names."""
        for index in range(len(self.processes), number):
            robot = f"fleet_{os.getpid()}_{index}"
            file = light_robot.write(self._folder, robot, RATE, False)
            process = self._start.Process(target=main, args=(file, self._model, index, self._where), name=robot)
            process.start()
            self.processes[robot] = process
        return list(self.processes)

    def stop(self) -> None:
        """End all of them, and kill those that do not."""
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            process.join(20.0)
            process.kill()


def wait_for(ear: Ear, robots: list[str]) -> float:
    """Until every robot's estimates arrive; how long [s] it took."""
    begun = time.monotonic()
    ear.forget()
    while not all(ear.arrived[robot] for robot in robots):
        if time.monotonic() - begun > READY_WITHIN:
            missing = [robot for robot in robots if not ear.arrived[robot]]
            raise TimeoutError(f"Nothing from {', '.join(missing)} within {READY_WITHIN:g} s.")
        time.sleep(0.1)
    return time.monotonic() - begun


def count(
    ears: dict[str, Ear], robots: list[str], pids: dict[str, int], bare: BareLoops, span: float
) -> dict[str, Any]:
    """What arrives, and what everybody costs, over so many seconds."""
    before, bare_before = {name: look(pid) for name, pid in pids.items()}, bare.counted()["bare"]
    for ear in ears.values():
        ear.forget()
    begun = time.monotonic()
    time.sleep(span)
    elapsed = time.monotonic() - begun
    heard = {name: ear.summary(robots) for name, ear in ears.items()}
    after, bare_after = {name: look(pid) for name, pid in pids.items()}, bare.counted()["bare"]
    return {
        "span": elapsed,
        "load": os.getloadavg()[0],
        "heard": heard,
        "cores": {name: (after[name]["cpu"] - before[name]["cpu"]) / elapsed for name in pids},
        "rss": {name: one["rss"] for name, one in after.items()},
        "own": {name: one["own"] for name, one in after.items()},
        "threads": {name: one["threads"] for name, one in after.items()},
        "bare_skipped": bare_after["skipped"] - bare_before["skipped"],
        "bare_ticks": bare_after["ticks"] - bare_before["ticks"],
    }


def run(numbers: tuple[int, ...], folder: Path) -> dict[str, Any]:
    """Grow, then kill one, then let one flood; logs, robot files and the model lie in a folder."""
    prepare_process()
    found: dict[str, Any] = {"rate": RATE, "steps": []}
    with Supervisor(folder) as supervisor:
        where = f"tcp/127.0.0.1:{free_port()}"
        router = supervisor.start("router", gemuco_command("router", "--listen", where))
        supervisor.wait_ready("router", lambda: b"listens" in router.log.read_bytes(), READY_WITHIN)
        fleet = Fleet(folder, where)
        ears = {"everything": Ear(where, "gemuco/**"), "estimates": Ear(where, keys.estimate("*"))}
        promote_rest(CLIENT_PRIORITY)
        bare = BareLoops({"bare": (RATE, PRIORITIES["estimation"])})
        with bare:
            try:
                for number in numbers:
                    robots = fleet.grow(number)
                    start = wait_for(ears["everything"], robots)
                    time.sleep(SETTLE)
                    pids = {name: process.pid or 0 for name, process in fleet.processes.items()}
                    pids |= {"router": router.process.pid, "client": os.getpid()}
                    step = count(ears, robots, pids, bare, SPAN) | {"robots": number, "until_all": start}
                    found["steps"].append(step)
                    (folder / "so_far.json").write_text(json.dumps(found, indent=1))
                    print(f"{number} robots: {step['heard']['everything']['rate_mean']:.2f} Hz each", flush=True)
                if len(robots) > 2:
                    found |= _break(fleet, ears, robots, pids, bare)
            finally:
                fleet.stop()
                for ear in ears.values():
                    ear.close()
    return found


def _break(
    fleet: Fleet, ears: dict[str, Ear], robots: list[str], pids: dict[str, int], bare: BareLoops
) -> dict[str, Any]:
    """One robot is killed; then another one floods."""
    killed, wild, *others = robots
    fleet.processes[killed].kill()
    del pids[killed]
    after_kill = count(ears, [wild, *others], pids, bare, SPAN / 2)
    os.kill(fleet.processes[wild].pid or 0, signal.SIGUSR1)
    time.sleep(1.0)
    flooded = count(ears, others, pids, bare, SPAN / 2)
    return {"killed": after_kill, "flooded": flooded | {"wild": wild}}


def show(found: dict[str, Any], console: Console) -> None:
    """The tables of docs/results.md."""
    table = Table(
        "robots", "Hz each (least)", "lost", "gaps", "p50 ms", "p99 ms", "% core/robot", "own MB/robot", "router %",
        "router MB", "client %", "kB/s/robot", "bare skipped", "load",
    )  # fmt: skip
    rows = [(str(step["robots"]), step) for step in found["steps"]]
    rows += [(name, found[name]) for name in ("killed", "flooded") if name in found]
    for name, step in rows:
        heard = step["heard"]["everything"]
        own = [one for one in step["cores"] if one not in ("router", "client") and one != step.get("wild")]
        table.add_row(
            name,
            f"{heard['rate_mean']:.2f} ({heard['rate_least']:.2f})",
            f"{heard['lost']} of {heard['arrived'] + heard['lost']}",
            f"{heard['gaps']}",
            f"{1e3 * heard['latency_p50']:.1f}",
            f"{1e3 * heard['latency_p99']:.1f}",
            f"{100 * np.mean([step['cores'][one] for one in own]):.1f}",
            f"{np.mean([step['own'][one] for one in own]):.0f}",
            f"{100 * step['cores']['router']:.1f}",
            f"{step['rss']['router']:.0f}",
            f"{100 * step['cores']['client']:.1f}",
            f"{sum(heard['bytes_per_s'].values()) / max(len(own), 1) / 1e3:.1f}",
            f"{step['bare_skipped']:.0f} of {step['bare_ticks']:.0f}",
            f"{step['load']:.1f}",
        )
    console.print(table)
    last = found["steps"][-1]
    heard, number = last["heard"]["everything"], last["robots"]
    sizes = Table("key", "messages/s per robot", "bytes each", "bytes/s per robot")
    for key in sorted(heard["bytes_per_s"]):
        often, much = heard["messages_per_s"][key] / number, heard["bytes_per_s"][key] / number
        sizes.add_row(key, f"{often:.2f}", f"{much / often:.0f}", f"{much:.0f}")
    console.print(sizes)
    if "flooded" in found:
        only = found["flooded"]["heard"]["estimates"]
        console.print(
            f"flooded, a session that hears estimates only: {only['rate_mean']:.2f} Hz each, lost {only['lost']}, "
            f"longest pause {only['longest_pause']:.2f} s"
        )
        flow = found["flooded"]["heard"]["everything"]["bytes_per_s"].get("simulator/truth", 0.0)
        console.print(f"what arrived of the flood: {flow / 1e6:.1f} MB/s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=list(NUMBERS))
    parser.add_argument("--out", type=Path, default=Path("runs/fleet.json"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    result = run(tuple(options.robots), options.out.with_suffix(""))
    options.out.write_text(json.dumps(result, indent=1))
    show(result, Console(width=170))
