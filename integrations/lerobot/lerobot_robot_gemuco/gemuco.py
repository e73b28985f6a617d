"""A robot of gemuco: observations with the marks of what was estimated, actions through lease and limits."""

import math
import time
from contextlib import ExitStack
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_gemuco.config_gemuco import GemucoConfig
from services import Client
from services.errors import ServiceError
from services.wire.messages import Estimates, Sample

MOVES = ("hold", "follow")
"""In these modes the HAL follows commands."""


class Gemuco(Robot):
    """A robot whose services run here or on another computer.

    The observation has for each element its value in the robot's unit, `ELEMENT.estimated` (1: it is not measured now),
    and `ELEMENT.std` (expected error, 0 if measured), and for each signal `SIGNAL.unknown` (1: the estimate is outside
    of what was learned). The HAL limits every action in range, rate and age; a client that dies lets the robot stop.
    """

    config_class = GemucoConfig
    name = "gemuco"

    def __init__(self, config: GemucoConfig) -> None:
        super().__init__(config)
        self.config = config
        self.cameras: dict[str, Any] = {}
        """LeRobot records the images of these; a robot of gemuco has none of its own."""
        self._open: ExitStack | None = None
        self._client: Client | None = None
        self._clip: tuple[np.ndarray, np.ndarray] | None = None

    @cached_property
    def _about(self) -> dict[str, Any]:
        """The HAL's description, which LeRobot needs before it connects."""
        if self._client is not None:
            return self._client.describe("hal", timeout=self.config.timeout)
        try:
            with Client(self.config.robot, self.config.connect, "lerobot") as client:
                return client.describe("hal", timeout=self.config.timeout)
        except ServiceError as error:
            raise DeviceNotConnectedError(str(error)) from None

    @property
    def _signals(self) -> dict[str, list[str]]:
        known = {name: list(about["elements"]) for name, about in self._about["signals"].items()}
        wanted = self.config.signals or list(known)
        if unknown := [name for name in wanted if name not in known]:
            raise ValueError(f"Robot '{self.config.robot}' has no signal '{unknown[0]}'. Known: {', '.join(known)}.")
        return {name: known[name] for name in wanted}

    @property
    def _commanded(self) -> tuple[str, list[str]]:
        signal = self._about["command"]["signal"]
        return signal, list(self._about["signals"][signal]["elements"])

    @property
    def observation_features(self) -> dict[str, type]:
        """The names of all numbers of an observation."""
        features: dict[str, type] = {}
        for signal, elements in self._signals.items():
            for element in elements:
                name = f"{signal}.{element}"
                features |= {name: float, f"{name}.estimated": float, f"{name}.std": float}
            features[f"{signal}.unknown"] = float
        return features

    @property
    def action_features(self) -> dict[str, type]:
        """The commanded elements, in the unit of the robot file."""
        signal, elements = self._commanded
        return {f"{signal}.{element}": float for element in elements}

    @property
    def is_connected(self) -> bool:
        """Whether the client is open; a service that is gone is reported by the next call."""
        return self._client is not None

    @property
    def is_calibrated(self) -> bool:
        """Always true: `gemuco calibrate` and the robot file are responsible."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def connect(self, calibrate: bool = True) -> None:
        """Open a client; to move the robot take its lease and enable its motors.

        Raises:
            DeviceAlreadyConnectedError: It is connected.
            DeviceNotConnectedError: A service is missing, another client has the lease, or the motors do not come up.
        """
        if self._client is not None:
            raise DeviceAlreadyConnectedError(f"{self} is connected already.")
        stack = ExitStack()
        try:
            self._client = client = stack.enter_context(Client(self.config.robot, self.config.connect, "lerobot"))
            self._read(Estimates, client.estimate)
            if self.config.moves:
                stack.enter_context(client.lease())
                stack.callback(self._rest)
                client.enable()
                self._wait_for_motors(client)
            self._clip = self._limits()
        except (ServiceError, DeviceNotConnectedError) as error:
            self._client = None
            stack.close()
            raise DeviceNotConnectedError(str(error)) from None
        self._open = stack

    def disconnect(self) -> None:
        """Stop the robot as its file says, give the lease back, and close the client."""
        if self._client is None or self._open is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        try:
            self._open.close()
        finally:
            self._client = self._open = None

    def get_observation(self) -> dict[str, float]:
        """Return the newest values.

        Raises:
            DeviceNotConnectedError: There is no fresh estimate; an old one is never returned.
        """
        estimate = self._read(Estimates, self._connected().estimate)
        values: dict[str, float] = {}
        for signal, elements in self._signals.items():
            for index, element in enumerate(elements):
                name = f"{signal}.{element}"
                value = float(estimate.values[signal][index])
                if not math.isfinite(value):
                    raise DeviceNotConnectedError(
                        f"{name} is neither measured nor can it be estimated now. Is its sensor connected?"
                    )
                values[name] = value
                values[f"{name}.estimated"] = float(estimate.estimated[signal][index])
                values[f"{name}.std"] = float(np.nan_to_num(estimate.std[signal][index]))
            values[f"{signal}.unknown"] = float(estimate.state.get(signal, "") == "unknown")
        return values

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Command the robot, and return what was sent, clipped to the limits of the robot file.

        Raises:
            ValueError: An element is missing, unknown, or not a finite number, or the robot is only observed; nothing
                is sent.
            DeviceNotConnectedError: The robot does not follow: its motors are off, or the lease was lost.
        """
        client = self._connected()
        if not self.config.moves:
            raise ValueError("This robot is only observed, because its setting `moves` is false.")
        signal, elements = self._commanded
        names = [f"{signal}.{element}" for element in elements]
        if set(action) != set(names):
            wrong = sorted(set(action) ^ set(names))
            raise ValueError(f"An action has {', '.join(names)}; missing or unknown here: {', '.join(wrong)}.")
        values = np.array([float(action[name]) for name in names])
        if not np.isfinite(values).all():
            raise ValueError(f"The action of {names[int(np.argmin(np.isfinite(values)))]} is not a finite number.")
        assert self._clip is not None
        values = np.clip(values, *self._clip)
        try:
            sample = self._read(Sample, client.sample)
            client.command(signal, values, sample)
            applied = client.applied(timeout=0.5)
        except ServiceError as error:
            raise DeviceNotConnectedError(str(error)) from None
        if applied is None or applied.mode not in MOVES:
            mode = "not known" if applied is None else f"'{applied.mode}'"
            raise DeviceNotConnectedError(f"The robot does not follow: the mode of its motors is {mode}.")
        return dict(zip(names, values.tolist(), strict=True))

    def _connected(self) -> Client:
        if self._client is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        return self._client

    def _read(self, kind: type, newest: Any) -> Any:
        """Return a fresh message, waiting for the first one."""
        try:
            message = newest(timeout=self.config.timeout if self._open is None else 0.5)
        except ServiceError as error:
            raise DeviceNotConnectedError(str(error)) from None
        if message is None:
            service = "model" if kind is Estimates else "HAL"
            raise DeviceNotConnectedError(
                f"No fresh message of the {service} of robot '{self.config.robot}'. Does it run, and is it connected?"
            )
        return message

    def _wait_for_motors(self, client: Client) -> None:
        """Wait until the motors are enabled; commands before are refused."""
        deadline = time.monotonic() + self.config.timeout
        while (applied := client.applied(timeout=0.5)) is None or applied.mode not in MOVES:
            if time.monotonic() > deadline:
                mode = "not known" if applied is None else f"'{applied.mode}'"
                raise DeviceNotConnectedError(f"The motors did not come up; their mode is {mode}.")
            time.sleep(0.02)

    def _rest(self) -> None:
        """Stop the robot; called before the lease is given back."""
        if self._client is not None:
            self._client.stop()

    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        signal, elements = self._commanded
        limit = self._about.get("limits", {}).get(signal, {})
        low, high = (
            np.broadcast_to(np.array(end if limit.get(key) is None else limit[key], float), len(elements))
            for key, end in (("low", -np.inf), ("high", np.inf))
        )
        return low, high
