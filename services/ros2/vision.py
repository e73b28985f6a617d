"""Topics of ROS 2 as signals of a robot that has a CAN bus: `gemuco vision ROBOT`, in a process of its own.

They travel as those of a camera do, so they never delay a cycle of the HAL, and no limit trips on them.
"""

import logging
import threading
import time
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from hal.by_signal import Numbers, Truths
from hal.clock import Clock, SystemClock
from hal.config import RobotConfig
from hal.errors import ConfigError
from services.process.loop import Loop
from services.process.service import Service, until_stopped
from services.ros2.incoming import Topic, topics_by_name
from services.ros2.link import RosLink
from services.ros2.settings import SignalTopic, network_of, topics_of
from services.wire import keys, messages
from services.wire.messages import Status

log = logging.getLogger(__name__)

SILENT_AFTER = 1.0
"""A topic without a message for this time [s] is silent."""


class RosVision:
    """The signals of topics, published as one sample whenever one of them is new.

    Args:
        robot: The robot file.
        signals: The signals and their topics.
        topics: Name -> newest messages of the topic.
        link: The connection to ROS 2.
        service: The process's session.
        clock: Source of time.
    """

    def __init__(
        self,
        robot: RobotConfig,
        signals: Sequence[SignalTopic],
        topics: Mapping[str, Topic],
        link: RosLink,
        service: Service,
        clock: Clock,
    ) -> None:
        self._robot, self._signals, self._topics = robot, tuple(signals), topics
        self._link, self._service, self._clock = link, service, clock
        self._targets = {one.signal: topics[one.topic].targets[one.signal] for one in signals}
        self._samples = service.publisher(keys.vision(robot.robot), messages.Sample)
        self._loop = Loop("ros2", robot.rates.hal, self.tick, clock)
        self._newest, self._cycle = -np.inf, 0
        service.watch(self._loop)

    def run(self, stop: threading.Event) -> None:
        """Publish until `stop` is set."""
        self._loop.start()
        try:
            self._service.run(self.status, stop)
        finally:
            self._loop.stop()

    def tick(self) -> None:
        """Publish a sample if a message has arrived; an old value is not valid."""
        for topic in self._topics.values():
            topic.update()
        newest = max(float(target.received.max()) for target in self._targets.values())
        if newest == self._newest:
            return
        self._newest, self._cycle = newest, self._cycle + 1
        now = self._clock.monotonic()
        age = Numbers.of({name: np.maximum(now - target.received, 0.0) for name, target in self._targets.items()})
        valid = {
            name: np.isfinite(target.values) & (age[name] <= self._robot.signals[name].stale_after)
            for name, target in self._targets.items()
        }
        values = {name: np.where(valid[name], target.values, np.nan) for name, target in self._targets.items()}
        self._samples.put(
            messages.Sample(
                stamp_ns=time.time_ns(),
                cycle=self._cycle,
                source="ros2",
                complete=all(part.all() for part in valid.values()),
                elements=age.elements,
                values=Numbers.of(values, age.elements),
                age=age,
                valid=Truths.of(valid, age.elements),
            )
        )

    def status(self) -> Status:
        """Return the state of the topics."""
        now = self._clock.monotonic()
        texts = [topic.news() for topic in self._topics.values()]
        for one in self._signals:
            if now - self._targets[one.signal].received.max() > SILENT_AFTER:
                texts.append(self._link.silence(one.topic))
        text = self._loop.trouble or next(filter(None, texts), "")
        return Status(
            stamp_ns=time.time_ns(),
            service=self._service.name,
            state="degraded" if text else "running",
            text=text,
            loops={"ros2": self._loop.statistics()},
            facts={"topics": {name: dict(topic.counters) for name, topic in self._topics.items()}},
        )


def run_ros_vision(config: RobotConfig, connect: Iterable[str] = (), stop: threading.Event | None = None) -> None:
    """Publish signals of ROS 2 until SIGTERM, SIGINT or `stop`.

    Args:
        config: The robot file.
        connect: Endpoints, such as a router's, and role files.
        stop: Ends the service in place of the signals.

    Raises:
        ConfigError: The robot file does not fit, or has signals of a camera too.
        AlreadyRunning: The robot has a camera already.
        ServiceError: No session opens.
    """
    others = [name for name in config.seen if config.signals[name].source != "ros2"]
    if others:
        raise ConfigError(
            f"Robot '{config.robot}' has signals of a camera ({', '.join(others)}) and of ROS 2, which one process "
            "publishes. Let a node of ROS 2 publish the camera's too, and set `source: ros2`."
        )
    clock = SystemClock()
    signals = topics_of(config)
    topics = topics_by_name(signals, clock)
    link = RosLink(f"/{config.robot}/vision", network_of(config), topics.values(), {})
    about = {"signals": {one.signal: {"topic": one.topic, "elements": list(one.elements)} for one in signals}}
    with until_stopped(stop) as end, Service(config.robot, "vision", connect, lambda: about) as service:
        link.start()
        try:
            RosVision(config, signals, topics, link, service, clock).run(end)
        finally:
            link.stop()
