"""A client that keeps a robot engaged and gives it targets."""

import contextlib
import threading
import time

import numpy as np

from hal.config import RobotConfig
from hal.errors import CommandRefused, HalError
from services.client import Client
from services.errors import NotEngaged, ServiceError

PATIENCE = 15.0


def measures(client: Client) -> bool:
    """Whether this process receives estimates in which every signal is measured."""
    estimate = client.estimate()
    return estimate is not None and set(estimate.method.values()) == {"measured"}


def engage(client: Client) -> None:
    """Engage the controller, also from a fault.

    Raises:
        TimeoutError: It was not engaged within 15 s.
    """
    deadline, refusal = time.monotonic() + PATIENCE, ""
    while time.monotonic() < deadline:
        applied = client.applied(timeout=1.0)
        mode = "unheard" if applied is None else applied.mode
        if mode in ("hold", "follow"):
            return
        try:
            if mode == "fault":
                client.reset()
            if mode != "enabling":
                client.engage()
        except (CommandRefused, NotEngaged) as error:
            refusal = str(error)
            with contextlib.suppress(CommandRefused):  # a drive may be in fault while the robot is off
                client.reset()
        time.sleep(0.3)
    raise TimeoutError(f"The controller was not engaged within {PATIENCE:g} s. {refusal}")


class Mover:
    """Thread that keeps the robot engaged and sends random targets.

    Args:
        client: A client of the robot.
        robot: The robot file's content.
        every: Time [s] between targets.
        reach: Share of the joint range from which targets are drawn.
    """

    def __init__(self, client: Client, robot: RobotConfig, every: float, reach: float) -> None:
        self.counted = {"targets": 0, "engaged": 0, "refused": 0}
        self.last_refusal = ""
        self._client, self._every = client, every
        low, high = robot.bounds("joint_position")
        self._middle, self._half = (low + high) / 2, reach * (high - low) / 2
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
        while not self._stop.wait(self._every):
            try:
                self._send()
            except (ServiceError, HalError, TimeoutError) as error:
                self.counted["refused"] += 1
                self.last_refusal = str(error)

    def _send(self) -> None:
        applied = self._client.applied(timeout=1.0)
        if applied is None or applied.mode not in ("follow", "hold", "enabling"):
            self.counted["engaged"] += 1
            engage(self._client)
        self._client.target("joint_position", self._middle + self._half * self._random.uniform(-1, 1, len(self._half)))
        self.counted["targets"] += 1
