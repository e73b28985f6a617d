"""The HAL of a robot whose drivers are ROS 2 nodes: `gemuco hal ROBOT` with topics in place of buses."""

import threading
from collections.abc import Iterable, Iterator

from hal.clock import Clock, SystemClock
from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.finding.doctor import Finding, bad, ok
from hal.robot import Robot
from services.errors import ServiceError
from services.hardware.hal_service import run_hal
from services.ros2.devices import RosDrive, RosSensor
from services.ros2.incoming import Topic, topics_by_name
from services.ros2.link import RosLink
from services.ros2.names import Kind
from services.ros2.node import Node
from services.ros2.settings import COMMANDS, network_of, topics_of


def ros_robot(config: RobotConfig, link: RosLink, topics: dict[str, Topic], clock: Clock) -> Robot:
    """Make a robot of its topics, not open yet.

    Raises:
        ConfigError: The robot file does not fit.
    """
    devices: list[RosSensor] = []
    for signal in topics_of(config):
        topic = topics[signal.topic]
        if signal.signal == config.command.signal:
            devices.append(RosDrive(signal, topic, link, clock, config.command, 1.0 / config.rates.hal))
        else:
            devices.append(RosSensor(signal, topic, link, clock))
    return Robot(config, devices, clock=clock, source="ros2")


def run_ros_hal(config: RobotConfig, connect: Iterable[str] = (), stop: threading.Event | None = None) -> int:
    """Run the HAL of a robot whose drivers are ROS 2 nodes, until SIGTERM, SIGINT or `stop`; see `run_hal`."""
    clock = SystemClock()
    topics = topics_by_name(topics_of(config), clock)
    command = config.command
    commands = {command.topic: COMMANDS[command.message]} if command.topic else {}
    link = RosLink(f"/{config.robot}/hal", network_of(config), topics.values(), commands)
    robot = ros_robot(config, link, topics, clock)
    link.start()
    try:
        return run_hal(config, connect, stop, lambda _: robot)
    finally:
        link.stop()


def check_topics(config: RobotConfig) -> Iterator[Finding]:
    """Yield findings for `gemuco doctor` on the topics of a robot; none for a robot without topics."""
    if not any(signal.source == "ros2" for signal in config.signals.values()):
        return
    try:
        signals, network = topics_of(config), network_of(config)
    except ConfigError as error:
        yield bad("topics", str(error))
        return
    command = config.command
    try:
        with Node(f"/{config.robot}/doctor", network) as node:
            yield ok("router of ROS 2", f"It answers at {network.router}, domain {network.domain}.")
            for topic, kind in dict.fromkeys((one.topic, one.kind) for one in signals):
                text = node.mismatch(Kind.PUBLISHER, topic, kind)
                yield bad(f"topic {topic}", text) if text else ok(f"topic {topic}", f"It has a publisher of {kind}.")
            if command.topic:
                kind = COMMANDS[command.message]
                text = node.mismatch(Kind.SUBSCRIPTION, command.topic, kind)
                well = ok(f"topic {command.topic}", f"A node takes {kind}.")
                yield bad(f"topic {command.topic}", text) if text else well
    except ServiceError as error:
        yield bad("router of ROS 2", str(error))
