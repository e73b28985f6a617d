"""The process that plays the camera of a simulated robot: it looks at what is true, and publishes what it sees.

A real camera's program takes its place by publishing on the same key; examples/publish_marker.py does, in a few lines.
"""

import logging
import threading
import time
from collections.abc import Iterable
from typing import Any

import numpy as np

from hal.by_signal import Numbers, Truths
from hal.clock import SystemClock
from hal.config import RobotConfig
from hal.errors import ConfigError
from services.hardware.stand_in import Camera, simulator_of, variant_of
from services.process.loop import Loop
from services.process.service import Service, until_told
from services.wire import keys, messages
from services.wire.messages import MessageError, Status

log = logging.getLogger(__name__)

RATE = 30.0
"""Frames per second [Hz]."""


class VisionService:
    """A simulated camera on zenoh.

    It publishes a frame for a new truth, and nothing while the simulator is silent: a camera that repeats itself would
    make a body that moves look still.

    Args:
        robot: The robot file.
        camera: What sees.
        service: The process's session.
        variant: Which variant of the robot it looks at; told in the status.
    """

    def __init__(self, robot: RobotConfig, camera: Camera, service: Service, variant: str) -> None:
        self._robot, self._camera, self._service, self._variant = robot, camera, service, variant
        self._clock = SystemClock()
        self._truth = service.newest(keys.truth(robot.robot), messages.Sample)
        self._frames = service.publisher(keys.vision(robot.robot), messages.Sample)
        self._loop = Loop("camera", RATE, self.tick, self._clock)
        self._lock = threading.Lock()
        self._looked_at: messages.Sample | None = None
        self._looked_when = -np.inf
        self._cycle = 0
        self._hidden: list[str] = []
        service.watch(self._loop)
        service.verb("fault", self._fault)

    def run(self, stop: threading.Event) -> None:
        """Look until `stop` is set."""
        self._loop.start()
        try:
            self._service.run(self.status, stop)
        finally:
            self._loop.stop()

    def tick(self) -> None:
        """Publish a frame if there is a new truth to look at."""
        last = self._truth.last()
        if last is None or last.message is self._looked_at:
            return
        truth, received = last
        with self._lock:
            seen = self._camera.see(truth.values)
        values = Numbers.of({name: seen[name] for name in self._robot.seen})
        now = self._clock.monotonic()
        age = max(now - received, 0.0)
        self._looked_at, self._looked_when = truth, now
        self._cycle += 1
        self._hidden = [name for name, value in values.items() if not np.isfinite(value).all()]
        self._frames.put(
            messages.Sample(
                stamp_ns=truth.stamp_ns,
                cycle=self._cycle,
                source="simulated",
                complete=True,
                elements=values.elements,
                values=values,
                age=Numbers(np.full_like(values.flat, age), values.elements),
                valid=Truths(np.isfinite(values.flat), values.elements),
            )
        )

    def status(self) -> Status:
        """What is seen, in a word."""
        loops = {"camera": self._loop.statistics()}
        text = self._loop.trouble
        if self._clock.monotonic() - self._looked_when > 2.0 / RATE + 0.5:
            text = "There is nothing to look at: no truth comes from the simulator. Is `gemuco simulate` running?"
        elif self._hidden and not text:
            text = f"Out of sight: {', '.join(self._hidden)}."
        return Status(
            stamp_ns=time.time_ns(),
            service=self._service.name,
            state="degraded" if text else "running",
            text=text,
            loops=loops,
            facts={"variant": self._variant, "frames": self._cycle, "rejected": self._truth.rejected},
        )

    def _fault(self, arguments: dict[str, Any]) -> dict[str, str]:
        text = arguments.get("text")
        if not isinstance(text, str) or not text.strip():
            raise MessageError("The verb 'fault' takes {text: what to break}, as in 'camera_covered'.")
        with self._lock:
            done = self._camera.fault(text.strip())
        log.info("%s", done)
        return {"text": done}


def run_vision(
    robot: RobotConfig,
    variant: str | None = None,
    seed: int = 0,
    connect: Iterable[str] = (),
    stop: threading.Event | None = None,
) -> None:
    """Play the camera of a simulated robot until SIGTERM, SIGINT or `stop`.

    Args:
        robot: The robot file.
        variant: One of the simulator's variants; the designer's if None.
        seed: Chooses among the robots of a variant, and the camera's noise: the one given to `gemuco simulate`.
        connect: Endpoints, such as a router's, and role files.
        stop: Ends the service in place of the signals.

    Raises:
        ConfigError: The robot has nothing that a camera sees, no simulator, or no such variant.
        AlreadyRunning: Somebody looks at the robot already.
        ServiceError: No session.
    """
    if not robot.seen:
        raise ConfigError(f"Robot '{robot.robot}' has no signal with `source: vision`, so there is nothing to look at.")
    variant = variant_of(robot, variant)
    camera = simulator_of(robot).vision(robot, variant, seed)
    signals = {
        name: {"unit": robot.signals[name].unit, "elements": robot.signals[name].elements} for name in robot.seen
    }
    told_apart = {"variant": variant, "seed": seed, "rate": RATE, "signals": signals}
    with until_told(stop) as told, Service(robot.robot, "vision", connect, lambda: told_apart) as service:
        log.info("The camera of robot '%s' runs (%s, seed %d)", robot.robot, variant, seed)
        VisionService(robot, camera, service, variant).run(told)
