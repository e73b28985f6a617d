"""The HAL of a robot whose drivers are ROS 2 nodes: `gemuco hal ROBOT` with topics in place of buses."""

import threading
from collections.abc import Iterable

from hal.clock import Clock, SystemClock
from hal.config import RobotConfig
from hal.robot import Robot
from services.hardware.hal_service import run_hal
from services.ros2.devices import RosDrive, RosSensor
from services.ros2.incoming import Topic, topics_by_name
from services.ros2.link import RosLink
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
