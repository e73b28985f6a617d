"""Many robots through one router: the cost of each, whether every estimate arrives, and the effect of one on others.

    python -m studies.stack.fleet

Light robots (two joints, three signals; HAL service and model service in one process each, without a bus, forked from
a process that has loaded the program) join one after the other until there are 1, 2, 5, 10 and 20. One router process;
this process is the remote client. One of its sessions subscribes to everything, `gemuco/**`, a second one to the
estimates only. Per number of robots: estimates that arrive, the age of the measurement in them when they arrive, gaps,
and processor time and memory of robots, router and client; a bare timer loop with the rate and priority of the
estimation shows what the machine adds. Then one robot is killed, and another one floods the network.
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
from studies.stack.arrivals import Arrivals
from studies.stack.in_process import main
from studies.stack.processes import BareLoops, look
from studies.stack.soak.robot import free_port

NUMBERS = (1, 2, 5, 10, 20)
RATE = 20.0
"""Rate of HAL and estimation [Hz]."""
SETTLE, SPAN = 4.0, 20.0
"""Times [s] to wait after all robots are there, and to count."""
GAP = 0.25
"""A longer pause [s] between two estimates counts as a gap; five periods."""
CYCLES = 64
"""Number of a robot's newest cycles whose stamps are kept, to find the measurement behind an estimate."""
CLIENT_PRIORITY = 20
READY_WITHIN = 400.0


class Ear:
    """One session of the remote client: counts the messages of a key expression."""

    def __init__(self, router: str, expression: str) -> None:
        self._session = open_session("fleet", CLIENT, (router,))
        self._stamps: dict[str, OrderedDict[int, int]] = defaultdict(OrderedDict)
        self.arrivals: dict[str, Arrivals] = defaultdict(lambda: Arrivals(GAP))
        self.restart()
        self._subscriber = self._session.declare_subscriber(expression, self._receive)

    def close(self) -> None:
        """Leave the network."""
        close_session(self._session)

    def restart(self) -> None:
        """Restart the count."""
        self.begun = time.monotonic()
        for arrivals in list(self.arrivals.values()):
            arrivals.restart()
        self.sizes: dict[str, list[int]] = defaultdict(lambda: [0, 0])
        self.latency: dict[str, list[float]] = defaultdict(list)

    def _receive(self, sample: zenoh.Sample) -> None:
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        robot, service, noun = keys.parse(key)
        size = self.sizes[f"{service}/{noun}"]
        size[0] += 1
        size[1] += len(payload)
        stamps = self._stamps[robot]
        if (service, noun) == ("hal", "sample"):
            message = msgpack.unpackb(payload)
            stamps[message["cycle"]] = message["stamp_ns"]
            if len(stamps) > CYCLES:
                stamps.popitem(last=False)
        elif (service, noun) == ("model", "estimate"):
            message = msgpack.unpackb(payload)
            self.arrivals[robot].add(message)
            measured = stamps.get(message["cycle"])
            if measured is not None:
                self.latency[robot].append((time.time_ns() - measured) * 1e-9)

    def summary(self, robots: list[str]) -> dict[str, Any]:
        """Return what arrived from these robots since the last `restart`."""
        elapsed = time.monotonic() - self.begun
        latency = np.concatenate([np.array(self.latency[robot]) for robot in robots])
        p50, p99 = np.quantile(latency, (0.5, 0.99)) if len(latency) else (np.nan, np.nan)
        counts = [self.arrivals[robot] for robot in robots]
        rates = [count.arrived / elapsed for count in counts]
        return {
            "rate_least": min(rates),
            "rate_mean": float(np.mean(rates)),
            "arrived": sum(count.arrived for count in counts),
            "lost": sum(count.lost for count in counts),
            "gaps": sum(count.gaps for count in counts),
            "longest_pause": max(count.longest for count in counts),
            "latency_p50": float(p50),
            "latency_p99": float(p99),
            "bytes_per_s": {key: size / elapsed for key, (_, size) in self.sizes.items()},
            "messages_per_s": {key: count / elapsed for key, (count, _) in self.sizes.items()},
        }


class Fleet:
    """The robots' processes."""

    def __init__(self, folder: Path, router: str) -> None:
        self.processes: dict[str, BaseProcess] = {}
        self._start = multiprocessing.get_context("forkserver")
        self._start.set_forkserver_preload(["studies.stack.in_process"])
        from studies.stack import light_model  # not at the top: a robot's process imports this module

        self._folder, self._router, self._model = folder, router, folder / "model"
        light_model.make(light_robot.write(folder, "fleet_any", RATE, False), self._model)

    def grow(self, number: int) -> list[str]:
        """Start robots up to a number; return the names of all."""
        for index in range(len(self.processes), number):
            robot = f"fleet_{os.getpid()}_{index}"
            file = light_robot.write(self._folder, robot, RATE, False)
            process = self._start.Process(target=main, args=(file, self._model, index, self._router), name=robot)
            process.start()
            self.processes[robot] = process
        return list(self.processes)

    def stop(self) -> None:
        """End all of them, and kill those that do not end within 20 s."""
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            process.join(20.0)
            process.kill()


def wait_for(ear: Ear, robots: list[str]) -> float:
    """Wait until every robot's estimates arrive; return the time [s] it took.

    Raises:
        TimeoutError: A robot's estimates did not arrive within `READY_WITHIN`.
    """
    begun = time.monotonic()
    ear.restart()
    while missing := [robot for robot in robots if not ear.arrivals[robot].arrived]:
        if time.monotonic() - begun > READY_WITHIN:
            raise TimeoutError(f"No estimate of {', '.join(missing)} within {READY_WITHIN:g} s.")
        time.sleep(0.1)
    return time.monotonic() - begun


def count(
    ears: dict[str, Ear], robots: list[str], pids: dict[str, int], bare: BareLoops, span: float
) -> dict[str, Any]:
    """Count arrivals and costs of all processes over a time span [s]."""
    before, bare_before = {name: look(pid) for name, pid in pids.items()}, bare.counted()["bare"]
    for ear in ears.values():
        ear.restart()
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
        "rss": {name: state["rss"] for name, state in after.items()},
        "own": {name: state["own"] for name, state in after.items()},
        "bare_skipped": bare_after["skipped"] - bare_before["skipped"],
        "bare_ticks": bare_after["ticks"] - bare_before["ticks"],
    }


def run(numbers: tuple[int, ...], folder: Path) -> dict[str, Any]:
    """Grow, then kill one robot, then let one flood; logs, robot files and the model lie in a folder."""
    prepare_process()
    result: dict[str, Any] = {"rate": RATE, "steps": []}
    with Supervisor(folder) as supervisor:
        address = f"tcp/127.0.0.1:{free_port()}"
        router = supervisor.start("router", gemuco_command("router", "--listen", address))
        supervisor.wait_ready("router", lambda: b"listens" in router.log.read_bytes(), READY_WITHIN)
        fleet = Fleet(folder, address)
        ears = {"everything": Ear(address, "gemuco/**"), "estimates": Ear(address, keys.estimate("*"))}
        promote_rest(CLIENT_PRIORITY)
        with BareLoops({"bare": (RATE, PRIORITIES["estimation"])}) as bare:
            try:
                for number in numbers:
                    robots = fleet.grow(number)
                    start = wait_for(ears["everything"], robots)
                    time.sleep(SETTLE)
                    pids = {name: process.pid or 0 for name, process in fleet.processes.items()}
                    pids |= {"router": router.process.pid, "client": os.getpid()}
                    step = count(ears, robots, pids, bare, SPAN) | {"robots": number, "until_all": start}
                    result["steps"].append(step)
                    print(f"{number} robots: {step['heard']['everything']['rate_mean']:.2f} Hz each", flush=True)
                if len(robots) > 2:
                    result |= _break(fleet, ears, robots, pids, bare)
            finally:
                fleet.stop()
                for ear in ears.values():
                    ear.close()
    return result


def _break(
    fleet: Fleet, ears: dict[str, Ear], robots: list[str], pids: dict[str, int], bare: BareLoops
) -> dict[str, Any]:
    """Kill one robot; then let another one flood."""
    killed, wild, *others = robots
    fleet.processes[killed].kill()
    del pids[killed]
    after_kill = count(ears, [wild, *others], pids, bare, SPAN / 2)
    os.kill(fleet.processes[wild].pid or 0, signal.SIGUSR1)
    time.sleep(1.0)
    flooded = count(ears, others, pids, bare, SPAN / 2)
    return {"killed": after_kill, "flooded": flooded | {"wild": wild}}


def show(result: dict[str, Any], console: Console) -> None:
    """Print the tables of docs/results_running.md."""
    table = Table(
        "robots", "Hz each (least)", "lost", "gaps", "p50 ms", "p99 ms", "% core/robot", "own MB/robot", "router %",
        "router MB", "client %", "kB/s/robot", "bare skipped", "load",
    )  # fmt: skip
    rows = [(str(step["robots"]), step) for step in result["steps"]]
    rows += [(name, result[name]) for name in ("killed", "flooded") if name in result]
    for name, step in rows:
        heard = step["heard"]["everything"]
        robots = [process for process in step["cores"] if process not in ("router", "client", step.get("wild"))]
        table.add_row(
            name,
            f"{heard['rate_mean']:.2f} ({heard['rate_least']:.2f})",
            f"{heard['lost']} of {heard['arrived'] + heard['lost']}",
            f"{heard['gaps']}",
            f"{1e3 * heard['latency_p50']:.1f}",
            f"{1e3 * heard['latency_p99']:.1f}",
            f"{100 * np.mean([step['cores'][robot] for robot in robots]):.1f}",
            f"{np.mean([step['own'][robot] for robot in robots]):.0f}",
            f"{100 * step['cores']['router']:.1f}",
            f"{step['rss']['router']:.0f}",
            f"{100 * step['cores']['client']:.1f}",
            f"{sum(heard['bytes_per_s'].values()) / max(len(robots), 1) / 1e3:.1f}",
            f"{step['bare_skipped']:.0f} of {step['bare_ticks']:.0f}",
            f"{step['load']:.1f}",
        )
    console.print(table)
    last = result["steps"][-1]
    heard, number = last["heard"]["everything"], last["robots"]
    sizes = Table("key", "messages/s per robot", "bytes each", "bytes/s per robot")
    for key in sorted(heard["bytes_per_s"]):
        often, much = heard["messages_per_s"][key] / number, heard["bytes_per_s"][key] / number
        sizes.add_row(key, f"{often:.2f}", f"{much / often:.0f}", f"{much:.0f}")
    console.print(sizes)
    if "flooded" in result:
        only = result["flooded"]["heard"]["estimates"]
        flow = result["flooded"]["heard"]["everything"]["bytes_per_s"].get("simulator/truth", 0.0)
        console.print(
            f"flooded with {flow / 1e6:.1f} MB/s, a session that subscribes to estimates only: "
            f"{only['rate_mean']:.2f} Hz each, lost {only['lost']}, longest pause {only['longest_pause']:.2f} s"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=list(NUMBERS))
    parser.add_argument("--out", type=Path, default=Path("runs/fleet.json"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    outcome = run(tuple(options.robots), options.out.with_suffix(""))
    options.out.write_text(json.dumps(outcome, indent=1))
    show(outcome, Console(width=170))
