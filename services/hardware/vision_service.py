"""The process that is the camera of a simulated robot: it computes the vision signals from the simulator's truth.

The program of a real camera publishes on the same key instead; examples/publish_marker.py shows this in a few lines.
"""

import logging
import threading
import time
from collections.abc import Iterable

import numpy as np

from hal.by_signal import Numbers, Truths
from hal.clock import SystemClock
from hal.config import RobotConfig
from hal.errors import ConfigError
from services.hardware.stand_in import Camera, fault_verb, simulator_of, variant_of
from services.process.loop import Loop
from services.process.service import Service, until_stopped
from services.wire import keys, messages
from services.wire.messages import Status

log = logging.getLogger(__name__)

RATE = 30.0
"""The camera publishes frames at this rate [Hz]."""


class VisionService:
    """A simulated camera on zenoh.

    It publishes one frame for each new truth, and nothing while the simulator is silent: with repeated frames a moving
    body would seem to be at rest.

    Args:
        robot: The robot file.
        camera: The simulated camera.
        service: The process's session.
        variant: Variant of the robot, for the status.
    """

    def __init__(self, robot: RobotConfig, camera: Camera, service: Service, variant: str) -> None:
        self._robot, self._camera, self._service, self._variant = robot, camera, service, variant
        self._clock = SystemClock()
        self._truth = service.newest(keys.truth(robot.robot), messages.Sample)
        self._frames = service.publisher(keys.vision(robot.robot), messages.Sample)
        self._loop = Loop("camera", RATE, self.tick, self._clock)
        self._lock = threading.Lock()
        self._last_truth: messages.Sample | None = None
        self._last_frame_at = -np.inf
        self._cycle = 0
        self._hidden: list[str] = []
        service.watch(self._loop)
        service.verb("fault", fault_verb(self._fault, "camera_covered"))

    def run(self, stop: threading.Event) -> None:
        """Publish frames until `stop` is set."""
        self._loop.start()
        try:
            self._service.run(self.status, stop)
        finally:
            self._loop.stop()

    def tick(self) -> None:
        """Publish a frame if a new truth has arrived."""
        last = self._truth.last()
        if last is None or last.message is self._last_truth:
            return
        truth, received = last
        with self._lock:
            frame = self._camera.see(truth.values)
        values = Numbers.of({name: frame[name] for name in self._robot.seen})
        now = self._clock.monotonic()
        age = max(now - received, 0.0)
        self._last_truth, self._last_frame_at = truth, now
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
        """Return the state of the camera, with the signals that are out of sight."""
        loops = {"camera": self._loop.statistics()}
        text = self._loop.trouble
        if self._clock.monotonic() - self._last_frame_at > 2.0 / RATE + 0.5:
            text = "No truth arrives from the simulator. Is `gemuco simulate` running?"
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

    def _fault(self, text: str) -> str:
        with self._lock:
            return self._camera.fault(text)


def run_vision(
    robot: RobotConfig,
    variant: str | None = None,
    seed: int = 0,
    connect: Iterable[str] = (),
    stop: threading.Event | None = None,
) -> None:
    """Run the camera of a simulated robot until SIGTERM, SIGINT or `stop`.

    Args:
        robot: The robot file.
        variant: One of the simulator's variants; None for the designer's.
        seed: Chooses among the robots of a variant, and the camera's noise; as for `gemuco simulate`.
        connect: Endpoints, such as a router's, and role files.
        stop: Ends the service in place of the signals.

    Raises:
        ConfigError: The robot has no vision signal, no simulator, or no such variant.
        AlreadyRunning: The robot has a camera already.
        ServiceError: No session opens.
    """
    if not robot.seen:
        raise ConfigError(f"Robot '{robot.robot}' has no signal with `source: vision`, so it needs no camera.")
    variant = variant_of(robot, variant)
    camera = simulator_of(robot).vision(robot, variant, seed)
    signals = {
        name: {"unit": robot.signals[name].unit, "elements": robot.signals[name].elements} for name in robot.seen
    }
    identity = {"variant": variant, "seed": seed, "rate": RATE, "signals": signals}
    with until_stopped(stop) as end, Service(robot.robot, "vision", connect, lambda: identity) as service:
        log.info("The camera of robot '%s' runs (%s, seed %d)", robot.robot, variant, seed)
        VisionService(robot, camera, service, variant).run(end)
