"""A robot whose simulated body lies in the HAL's own process, in real time and without a bus.

    python -m studies.stack.in_process ROBOT_FILE [--model FOLDER] [--seed 1] [--connect ENDPOINT]

Simulated nodes on a simulated bus cost more than what is measured beside them. With a model folder the model service
runs in the same process. Runs until SIGTERM; on SIGUSR1 it floods the key of the truth until it ends.
"""

import argparse
import contextlib
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import zenoh

from hal import registry
from hal.clock import SystemClock
from hal.config import RobotConfig, load_robot
from hal.robot import Robot
from services.hardware.hal_service import HalService
from services.model.serve import serve
from services.process.realtime import prepare_process
from services.process.service import Service, until_stopped
from services.wire import keys
from simulators.direct import DirectDevice
from simulators.world import World

FLOOD_BYTES = 10_000


class LiveDevice(DirectDevice):
    """A simulated world that advances in real time between two reads."""

    def __init__(self, config: RobotConfig, world: World) -> None:
        super().__init__(config, world, SystemClock())  # type: ignore[arg-type]
        self._live, self._before = world, time.monotonic()

    def read(self) -> Any:
        """Advance the world to the present and read it."""
        now = time.monotonic()
        self._live.step(now - self._before)
        self._before = now
        return super().read()


def in_process(config: RobotConfig, seed: int) -> Robot:
    """Return a robot without a bus, in real time, with the first variant of its simulator."""
    simulator = registry.load_object(config.simulator or "", "simulator", ())
    world = simulator.world(simulator.variants[0], seed)
    return Robot(config, [LiveDevice(config, world)], source="simulated")


def flood(service: Service) -> None:
    """Put messages as fast as possible until the session is closed."""
    key, payload = keys.truth(service.robot), os.urandom(FLOOD_BYTES)
    with contextlib.suppress(zenoh.ZError):
        while True:
            for _ in range(10):
                service.session.put(key, payload)
            time.sleep(0)


def main(file: Path, model: Path | None, seed: int, endpoint: str) -> None:
    """Run the services until SIGTERM."""
    if model is None:
        prepare_process()
    config, connect = load_robot(file), (endpoint,) if endpoint else ()
    is_wild = threading.Event()
    signal.signal(signal.SIGUSR1, lambda *_: is_wild.set())
    with until_stopped() as end, Service(config.robot, "hal", connect) as service:
        hal = HalService(config, in_process(config, seed), service)
        if model is None:
            hal.run(end)
            return
        threads = [
            threading.Thread(target=hal.run, args=(end,), name="hal service"),
            threading.Thread(target=serve, args=(config, model, connect, end), name="model service"),
        ]
        for thread in threads:
            thread.start()
        while not end.wait(0.2):
            if is_wild.is_set():
                is_wild.clear()
                threading.Thread(target=flood, args=(service,), daemon=True).start()
        for thread in threads:
            thread.join()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot_file", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--connect", default="")
    options = parser.parse_args()
    main(options.robot_file, options.model, options.seed, options.connect)
