"""Pause of the estimates at a remote client after `kill -9` of the model service, on a machine with other work.

    python -m studies.speed.pauses --times 8

Router, simulator, HAL and model of a light robot run as processes. The model is killed at random times and started
again at once. Each line has the pause until the next estimate that is based on measurements, the processor time that
the new process took for it, and the load of the machine.
"""

import argparse
import os
import random
import tempfile
import time
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zenoh

from services.process.supervisor import Supervisor
from services.wire import keys
from studies.stack.processes import cpu
from studies.stack.soak.robot import Robot, client_of

LONGEST = 60.0
"""A pause that is longer than this [s] ends the study."""


class Newest:
    """Time [monotonic s] and sender of the newest estimate that is based on measurements."""

    def __init__(self) -> None:
        self.at, self.boot = 0.0, 0

    def take(self, sample: zenoh.Sample) -> None:
        """Look at a message of the model."""
        message: dict[str, Any] = msgpack.unpackb(sample.payload.to_bytes())
        if set(message.get("method", {}).values()) - {"none"}:
            self.at, self.boot = time.monotonic(), message["boot"]


def run(times: int, folder: Path) -> list[float]:
    """Print a line per kill, and return the pauses [s]."""
    newest, chance, pauses = Newest(), random.Random(1), []
    with Supervisor(folder) as supervisor:
        robot = Robot(supervisor, f"pauses_{os.getpid()}", folder / "model")
        robot.start_router()
        with client_of(robot.name, robot.router) as client:
            robot.start(client)
            subscriber = client.session.declare_subscriber(keys.estimate(robot.name), newest.take)
            for _ in range(times):
                time.sleep(chance.uniform(0.5, 1.5))
                killed, boot = time.monotonic(), newest.boot
                robot.kill("model")
                while newest.boot == boot:
                    if time.monotonic() - killed > LONGEST:
                        raise TimeoutError(f"No estimate within {LONGEST:g} s.")
                    time.sleep(0.005)
                pauses.append(newest.at - killed)
                spent = cpu(supervisor.children["model"].process.pid)
                print(f"{pauses[-1]:6.2f} s, processor {spent:.2f} s, load {os.getloadavg()[0]:.1f}", flush=True)
            subscriber.undeclare()
    return pauses


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=8)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        seconds = run(options.times, Path(name))
    print(f"median {np.median(seconds):.2f} s, worst {max(seconds):.2f} s on {os.cpu_count()} cores")
