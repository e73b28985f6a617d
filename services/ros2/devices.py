"""Nodes of ROS 2 as devices of the HAL: a sensor is a signal on a topic, a drive a topic of set-points.

The HAL's limits, watchdogs, lease and time to live are in front of a drive as of any other device.
"""

import numpy as np
from typing_extensions import override

from hal.clock import Clock
from hal.config import CommandConfig
from hal.device import Device, DeviceHealth, DeviceState, Reading
from hal.errors import CommandRefused
from services.ros2 import messages
from services.ros2.incoming import Topic
from services.ros2.link import RosLink
from services.ros2.settings import SignalTopic

SILENT_AFTER = 1.0
"""A topic without a message for this time [s] is silent."""
CYCLES = 2.0
"""A set-point is reached after this number of cycles, so that a controller moves on until the next one comes."""


class RosSensor(Device):
    """One signal on a topic.

    Args:
        signal: The signal and its topic.
        topic: The newest messages of the topic.
        link: The connection.
        clock: Clock of the HAL's cycle.
    """

    def __init__(self, signal: SignalTopic, topic: Topic, link: RosLink, clock: Clock) -> None:
        self.name = f"{signal.signal} on {signal.topic}"
        self.measures = tuple(f"{signal.signal}.{element}" for element in signal.elements)
        self._signal, self._topic, self._link, self._clock = signal, topic, link, clock
        self._target = topic.targets[signal.signal]
        self._state = DeviceState.CLOSED

    @override
    def open(self) -> None:
        self._state = DeviceState.READY

    @override
    def read(self) -> Reading:
        self._topic.update()
        return Reading(self._target.values.copy(), self._target.received.copy())

    @override
    def health(self) -> DeviceHealth:
        counters = {name.replace(" ", "_"): count for name, count in self._topic.counters.items()}
        if self._state is DeviceState.CLOSED:
            return DeviceHealth(self._state, "", counters)
        silent = self._clock.monotonic() - self._target.received > SILENT_AFTER
        if silent.all():
            text = self._topic.news() or self._link.silence(self._signal.topic)
            return DeviceHealth(DeviceState.SILENT, text, counters)
        text = self._topic.news()
        if silent.any() and not text:
            names = ", ".join(name for name, one in zip(self._signal.elements, silent, strict=True) if one)
            text = f"Topic '{self._signal.topic}' has no {self._signal.field} of {names}."
        return DeviceHealth(self._state, text, counters)

    @override
    def close(self) -> None:
        self._state = DeviceState.CLOSED


class RosDrive(RosSensor):
    """The commanded signal: measured on one topic, its set-points published on another.

    Without power it publishes nothing. Whether the motors have power then is a matter of the ROS driver.

    Args:
        signal: The signal and its topic.
        topic: The newest messages of the topic.
        link: The connection.
        clock: Clock of the HAL's cycle.
        command: Topic of the set-points; an empty one for a robot that is only measured.
        period: Period of the cycle [s].
    """

    def __init__(
        self, signal: SignalTopic, topic: Topic, link: RosLink, clock: Clock, command: CommandConfig, period: float
    ) -> None:
        super().__init__(signal, topic, link, clock)
        self.commands = self.measures
        self._command, self._after = command, CYCLES * period

    @override
    def health(self) -> DeviceHealth:
        health = super().health()
        if health.state in (DeviceState.READY, DeviceState.ENABLED) and self._command.topic:
            deafness = self._link.deafness(self._command.topic)
            if deafness:
                return DeviceHealth(DeviceState.OPENING, deafness, health.counters)
        return health

    @property
    @override
    def has_power(self) -> bool:
        return self._state is DeviceState.ENABLED

    @override
    def enable(self) -> None:
        if not self._command.topic:
            raise CommandRefused("This robot is only measured: its file has no command.topic.")
        self._state = DeviceState.ENABLED

    @override
    def disable(self) -> None:
        if self._state is DeviceState.ENABLED:
            self._state = DeviceState.READY

    @override
    def apply(self, values: np.ndarray) -> None:
        if self._state is not DeviceState.ENABLED:
            return
        names = self._signal.elements
        if self._command.message == "JointTrajectory":
            message = messages.trajectory(0, names, values, self._after)
        else:
            message = messages.numbers(names, values)
        self._link.put(self._command.topic, message)
