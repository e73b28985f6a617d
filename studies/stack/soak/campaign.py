"""One run of the soak: a robot that moves, ten clients, and a fault in every minute."""

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hal.errors import HalError
from services.client import Client
from services.errors import ServiceError
from services.hardware.hal_service import CYCLE_PRIORITY
from services.model.gemuco_service import PRIORITIES
from services.process.realtime import prepare_process
from services.process.supervisor import Supervisor
from services.wire import keys
from studies.stack import light_robot
from studies.stack.arrivals import Arrivals
from studies.stack.driving import Mover
from studies.stack.processes import BareLoops, look
from studies.stack.soak.faults import PATIENCE, Faults, Program, own_disk
from studies.stack.soak.referee import Referee, unpacked
from studies.stack.soak.robot import Robot, client_of

BROKEN_AT, MENDED_AT, MINUTE = 10.0, 40.0, 60.0
TARGET_EVERY, REACH = 2.0, 0.5
GAP = 0.1
"""A longer pause [s] between two estimates counts as a gap at the client."""
DISK = 512
"""Size of the robot's disk [MB]."""
KILLS = 1.0 / 3.0
"""Processes are killed in this first part of the run; afterwards their memory is judged."""
PROMISES = 10
"""The promised std is the mean of this number of estimates."""


def run(minutes: int, out: Path, only: Sequence[str] = ()) -> dict[str, Any]:
    """Run the robot and write one row per minute into a file; `only` replaces the plan of faults."""
    prepare_process()
    folder = out.parent / "soak"
    with own_disk(folder / "disk", DISK) as is_disk:
        os.environ["XDG_RUNTIME_DIR"] = str((folder / "disk" / "run").absolute())
        with Supervisor(folder / "disk") as supervisor:
            robot = Robot(supervisor, f"soak_{os.getpid()}", folder / "model")
            robot.start_router()
            with client_of(robot.name, robot.router) as client:
                robot.start(client)
                return _run(robot, client, minutes, out, only, is_disk)


def _run(robot: Robot, client: Client, minutes: int, out: Path, only: Sequence[str], is_disk: bool) -> dict[str, Any]:
    arrivals = Arrivals(GAP)
    subscriber = client.session.declare_subscriber(
        keys.estimate(robot.name), unpacked("estimates", arrivals.add, lambda message: None)
    )
    priorities = {"hal": CYCLE_PRIORITY, **PRIORITIES}
    rates = {name: rate for name, rate in robot.config.rates.model_dump().items() if name in priorities}
    bare = BareLoops({name: (rate, priorities[name]) for name, rate in rates.items()})
    mover = Mover(client, robot.config, TARGET_EVERY, REACH)
    with bare, Program("watch", robot.name, robot.router) as watchers, mover:
        promised = promises(client, robot)
        faults = Faults(robot, client, promised, is_disk)
        faults.insist(lambda: client.adapt(True))
        referee = Referee(client.session, robot.name, promised)
        with_kills = round(KILLS * minutes)
        plan = list(only) or faults.schedule(minutes, with_kills)
        result: dict[str, Any] = {
            "minutes": minutes, "rates": rates, "rows": [], "plan": plan, "has_disk": is_disk,
            "promised": {name: std.tolist() for name, std in promised.items()},
            "judged_from": with_kills if not only else 0,
        }  # fmt: skip
        begun = time.monotonic()
        for number in range(minutes):
            name = plan[number % len(plan)]
            row = _minute(faults, name, referee, arrivals, begun + MINUTE * number)
            faults.insist(lambda: client.adapt(True))  # a model that was killed learns only after a request
            robot.tidy()
            pids = {**robot.pids(), "client": os.getpid(), "bare": bare.pid, "ten clients": watchers.process.pid}
            result["rows"].append(
                row | {
                    "minute": number + 1, "load": os.getloadavg()[0], "pids": pids,
                    "processes": {name: look(pid) for name, pid in pids.items()},
                    "loops": loops(client), "bare": bare.counted(),
                    "arrivals": {"arrived": arrivals.arrived, "lost": arrivals.lost, "gaps": arrivals.gaps},
                    "mover": dict(mover.counted) | {"last_refusal": mover.last_refusal},
                }
            )  # fmt: skip
            result |= {"referee": referee.summary(), "tracebacks": robot.all_tracebacks()}
            out.write_text(json.dumps(result, indent=1))
            print(f"{number + 1:3d} {name}: {row} {referee.summary()['longest'].get(name, 0.0):.2f}", flush=True)
        referee.close()
        result["clients"] = watchers.end()
    out.write_text(json.dumps(result, indent=1))
    subscriber.undeclare()
    return result


def promises(client: Client, robot: Robot) -> dict[str, np.ndarray]:
    """Return signal -> promised std of each element [its unit], shape (n,), while nothing is broken.

    Measured values have no std of their own. What the model promises for an element while it is hidden is the error
    that its trust in the others allows; the sensor's noise is the least.
    """
    deadline, drawn = time.monotonic() + PATIENCE, {name: [] for name in robot.config.signals}  # type: ignore[var-annotated]
    while min(map(len, drawn.values())) < PROMISES:
        for name, values in drawn.items():
            try:
                estimate = client.estimate(hide=[name])
            except (ServiceError, HalError):
                estimate = None
            if estimate is not None and estimate.method[name] == "mask":
                values.append(estimate.std[name])
        time.sleep(0.5)
        if time.monotonic() > deadline + PATIENCE:
            raise TimeoutError(f"The model of '{robot.name}' gave no std of a hidden signal.")
    return {name: np.maximum(np.mean(std, axis=0), light_robot.NOISE[name]) for name, std in drawn.items()}


def _minute(faults: Faults, name: str, referee: Referee, arrivals: Arrivals, begun: float) -> dict[str, Any]:
    """Let a fault begin and end; return its facts, among them recovery times [s]."""
    time.sleep(max(0.0, begun + BROKEN_AT - time.monotonic()))
    referee.fault = name
    with faults.by_name[name]() as row:
        if row["kind"] == "silent":
            row["until_estimated"] = arrivals.wait(light_robot.JOINT, row["index"], True, PATIENCE)
        time.sleep(max(0.0, begun + MENDED_AT - time.monotonic()))
    if row["kind"] == "silent":
        row["until_measured"] = arrivals.wait(light_robot.JOINT, row["index"], False, PATIENCE)
    time.sleep(max(0.0, begun + MINUTE - 5.0 - time.monotonic()))
    row["believed_by_hand"] = faults.believe_again()
    time.sleep(max(0.0, begun + MINUTE - 2.0 - time.monotonic()))
    row["measured_again"] = all(method == "measured" for method in arrivals.methods.values())
    time.sleep(max(0.0, begun + MINUTE - time.monotonic()))
    return {"fault": name, **row}


def loops(client: Client) -> dict[str, dict[str, float]]:
    """Return loop -> its statistics; services without a status are left out."""
    statuses = [client.status(service) for service in ("simulator", "hal", "model", "recorder")]
    return {name: loop for status in statuses if status is not None for name, loop in status.loops.items()}
