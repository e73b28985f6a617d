"""The process that simulates the robot: nodes on the robot file's buses. It takes faults and publishes the truth."""

import logging
import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import numpy as np

from hal.by_signal import Numbers, Truths
from hal.config import RobotConfig
from services.hardware.stand_in import condition_of, fault_verb, simulator_of, variant_of
from services.process import realtime
from services.process.loop import Loop
from services.process.service import Service, until_stopped
from services.wire import keys, messages
from services.wire.messages import Status

log = logging.getLogger(__name__)

TRUTH_RATE = 100.0
"""The truth is published at this rate [Hz]."""
PRIORITY = 15
"""The simulator runs above normal programs and below HAL and model. Above them it would wake for each frame of the HAL
instead of once per cycle, which costs a fifth of a core and the model every thirtieth anomaly tick."""
NETWORK_PRIORITY = 15
THREADS = ("physics", "nodes ", "hub ")


class Rig(Protocol):
    """Simulated hardware that runs in real time (`simulators.rig.Rig`)."""

    failure: str

    def start(self) -> None:
        """Run in real time until `stop`."""
        ...

    def stop(self) -> None:
        """Stop and close the world."""
        ...

    def fault(self, text: str) -> str:
        """Apply a fault, and return a sentence about it."""
        ...

    def truth(self) -> Mapping[str, np.ndarray]:
        """Return the true values of all signals [their units], shapes (n,)."""
        ...

    def stats(self) -> dict[str, Any]:
        """Return counters."""
        ...


class SimulatorService:
    """A running rig on zenoh.

    Args:
        robot: The robot's name.
        rig: A rig that is not started yet.
        service: The process's session.
        variant: Variant of the robot, for the status.
    """

    def __init__(self, robot: str, rig: Rig, service: Service, variant: str) -> None:
        self._rig = rig
        self._service = service
        self._variant = variant
        self._cycle = 0
        self._truth = service.publisher(keys.truth(robot), messages.Sample)
        self._loop = Loop("truth", TRUTH_RATE, self.tick, priority=PRIORITY)
        service.watch(self._loop)
        service.verb("fault", fault_verb(rig.fault, "muscle_cut biceps"))

    def run(self, stop: threading.Event) -> int:
        """Run the rig until `stop` is set or the rig fails; return the exit code."""
        self._rig.start()
        try:
            for prefix in THREADS:
                realtime.promote(prefix, PRIORITY)
            realtime.freeze()
            self._loop.start()
            realtime.promote_rest(NETWORK_PRIORITY)
            self._service.run(lambda: self._status(stop), stop)
        finally:
            self._loop.stop()
            self._rig.stop()
        return 1 if self._rig.failure else 0

    def tick(self) -> None:
        """Publish the true values."""
        values = Numbers.of(self._rig.truth())
        self._cycle += 1
        self._truth.put(
            messages.Sample(
                stamp_ns=time.time_ns(),
                cycle=self._cycle,
                source="truth",
                complete=True,
                elements=values.elements,
                values=values,
                age=Numbers(np.zeros_like(values.flat), values.elements),
                valid=Truths(np.ones(len(values.flat), bool), values.elements),
            )
        )

    def _status(self, stop: threading.Event) -> Status:
        failure = self._rig.failure
        if failure:
            log.error("The simulation failed: %s", failure)
            stop.set()
        return Status(
            stamp_ns=time.time_ns(),
            service=self._service.name,
            state="fault" if failure else "running",
            text=failure,
            loops={"truth": self._loop.statistics()},
            facts={"variant": self._variant, **self._rig.stats()},
        )


def run_simulator(
    config: RobotConfig,
    variant: str | None = None,
    seed: int = 0,
    condition: str | None = None,
    connect: Iterable[str] = (),
    stop: threading.Event | None = None,
) -> int:
    """Run the simulated hardware of a robot until SIGTERM, SIGINT or `stop`.

    Args:
        config: The robot file.
        variant: One of the simulator's variants; None for the designer's.
        seed: Chooses among the robots of a variant, and their noise.
        condition: One of the robot file's conditions; None for the first.
        connect: Endpoints, such as a router's, and role files.
        stop: Ends the service in place of the signals.

    Returns:
        The process's exit code; 1 if the simulation failed.

    Raises:
        ConfigError: The robot file names no existing simulator, or the variant or condition is unknown.
        AlreadyRunning: The robot has a simulator already.
        ServiceError: No session opens.
    """
    realtime.prepare_process()
    simulator = simulator_of(config)
    variant, condition = variant_of(config, variant), condition_of(config, condition)
    identity = {
        "variant": variant,
        "condition": condition,
        "seed": seed,
        "variants": list(simulator.variants),
        "conditions": list(simulator.conditions),
    }
    with until_stopped(stop) as end, Service(config.robot, "simulator", connect, lambda: identity) as service:
        log.info("Simulator of robot '%s' runs (%s, seed %d)", config.robot, variant, seed)
        rig = simulator.rig(config, variant, seed, condition)
        return SimulatorService(config.robot, rig, service, variant).run(end)
