"""Settings of ROS 2 in a robot file: the network of the section `ros2`, and the topics of the signals."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationError

from hal.bounds_config import Section
from hal.config import RobotConfig, explain
from hal.errors import ConfigError
from services.ros2 import messages
from services.ros2.node import ROUTER, Network

POSITIONS = ("rad", "m")
TYPES = {
    "position": messages.JOINT_STATE,
    "velocity": messages.JOINT_STATE,
    "effort": messages.JOINT_STATE,
    "data": messages.NUMBERS,
    "point": messages.POINT,
    "force": messages.WRENCH,
    "torque": messages.WRENCH,
}
"""Field -> type of the messages that have it."""
UNITS = {
    "position": POSITIONS,
    "velocity": ("rad/s", "m/s"),
    "effort": ("N m", "N"),
    "point": ("m",),
    "force": ("N",),
    "torque": ("N m",),
}
"""Field -> units in which ROS 2 has it; the numbers of a Float64MultiArray may have any."""
WITH_AXES = ("point", "force", "torque")
COMMANDS = {"JointTrajectory": messages.TRAJECTORY, "Float64MultiArray": messages.NUMBERS}


class Ros2Config(Section):
    """Part of ROS 2 in which the robot is."""

    router: str = ROUTER
    """zenoh endpoint of its router."""
    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """Number of the domain (`ROS_DOMAIN_ID`)."""
    distribution: str = Field(default="jazzy", pattern=r"^[a-z]+$")
    """Distribution of the nodes; in `humble` types have no hashes."""


@dataclass(frozen=True, slots=True)
class SignalTopic:
    """A signal on a topic.

    Attributes:
        topic: Full name.
        kind: ROS type of the messages.
        field: Field of the messages.
        elements: Names of the joints, of the axes x, y, z, or of the numbers in their order.
    """

    signal: str
    topic: str
    kind: str
    field: str
    elements: tuple[str, ...]


def network_of(config: RobotConfig) -> Network:
    """Return the network of a robot file; see `network_with`."""
    return network_with(config.ros2)


def network_with(section: Mapping[str, Any], **given: Any) -> Network:
    """Return the network of the section `ros2`; values that are given and not None replace those of the file.

    Raises:
        ConfigError: The section `ros2` has an unknown key, or a value does not fit.
    """
    changes = {name: value for name, value in given.items() if value is not None}
    try:
        config = Ros2Config.model_validate({**section, **changes})
    except ValidationError as error:
        raise ConfigError(f"ros2: {explain(error, Ros2Config)}") from None
    return Network(**config.model_dump())


def topics_of(config: RobotConfig) -> list[SignalTopic]:
    """Return the topics of all signals with `source: ros2`.

    Raises:
        ConfigError: A field does not exist, or its unit or elements are others than the signal's; or a commanded
            signal is not a position.
    """
    topics = []
    for name, signal in config.signals.items():
        if signal.source != "ros2":
            continue
        if signal.field not in TYPES:
            raise ConfigError(f"signals.{name}.field '{signal.field}' is not known. Known: {', '.join(TYPES)}.")
        units = UNITS.get(signal.field, (signal.unit,))
        if signal.unit not in units:
            raise ConfigError(
                f"signals.{name}: ROS 2 has {signal.field} in {' or '.join(units)}, not in {signal.unit}."
            )
        if signal.field in WITH_AXES and not set(signal.elements) <= set(messages.AXES):
            given = ", ".join(signal.elements)
            raise ConfigError(f"signals.{name}: the field {signal.field} has the elements x, y, z, not {given}.")
        topics.append(SignalTopic(name, signal.topic, TYPES[signal.field], signal.field, signal.elements))
    _check_command(config)
    kinds: dict[str, str] = {}
    for one in topics:
        if kinds.setdefault(one.topic, one.kind) != one.kind:
            raise ConfigError(f"Topic '{one.topic}' cannot have both {kinds[one.topic]} and {one.kind}.")
    return topics


def _check_command(config: RobotConfig) -> None:
    command = config.command
    signal = config.signals[command.signal]
    if command.topic and not (config.has_topics and command.topic.startswith("/")):
        raise ConfigError("command.topic is the full name of a topic, of a robot whose signals have `source: ros2`.")
    if command.topic and signal.unit not in POSITIONS:
        raise ConfigError(
            f"command.signal '{command.signal}' is in {signal.unit}. Topics of ROS 2 are commanded in positions only, "
            "because a controller goes on with its last velocity or effort when the HAL ends."
        )
    low, high = config.bounds(command.signal)
    limit = config.limits.get(command.signal)
    if command.topic and (limit is None or limit.rate is None or not np.isfinite([low, high]).all()):
        raise ConfigError(
            f"limits.{command.signal} needs `low`, `high` and `rate`, because the robot is commanded by a topic."
        )
