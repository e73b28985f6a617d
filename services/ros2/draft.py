"""A robot file for what a ROS 2 network publishes (`gemuco init --ros2`)."""

import math
import time
import xml.etree.ElementTree as Tree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import yaml
import zenoh

from hal.finding.urdf import root_of
from services.errors import ServiceError
from services.ros2 import cdr, messages
from services.ros2.names import Entity, Kind, ros_name
from services.ros2.node import Network, Node

LISTEN = 2.0
"""The topics are listened to for this time [s]."""
READABLE = (messages.JOINT_STATE, messages.NUMBERS, messages.WRENCH, messages.POINT)
TEXT = "std_msgs/msg/String"
JOINT_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
SLIDING_UNITS = {"position": "m", "velocity": "m/s", "effort": "N"}
NARROW, SLOW = 0.1, 0.2
"""Without a URDF a joint may move by this much to both sides [rad or m], at this rate [rad/s or m/s]."""
PERIODS, LEAST = 4.0, 0.05
"""A value is valid for this number of periods of its topic, and at least this time [s]."""
HEAD = """# Drafted by `gemuco init --ros2` from what the ROS 2 domain {domain} published.
# Check the limits and the topic of the commands before a client enables the robot: the HAL keeps these
# limits, and no others.
"""


@dataclass(slots=True)
class Heard:
    """Summary of the messages of one topic.

    Attributes:
        count: Number of messages.
        first: Arrival of the first [monotonic s].
        last: Arrival of the last [monotonic s].
        joints: Joint -> newest position; NaN without one.
        fields: Fields of a JointState that were not empty.
        size: Length of the newest Float64MultiArray.
    """

    count: int = 0
    first: float = 0.0
    last: float = 0.0
    joints: dict[str, float] = field(default_factory=dict)
    fields: set[str] = field(default_factory=set)
    size: int = 0

    @property
    def period(self) -> float:
        """Mean time between two messages [s]; infinite with fewer than two."""
        return (self.last - self.first) / (self.count - 1) if self.count > 1 else math.inf

    def take(self, kind: str, data: bytes) -> None:
        """Take a message; one that cannot be read counts as not heard."""
        message = cdr.decode(kind, data)
        now = time.monotonic()
        self.first = self.first if self.count else now
        self.last, self.count = now, self.count + 1
        if kind == messages.JOINT_STATE:
            self.fields |= {name for name in JOINT_UNITS if len(message[name])}
            for index, joint in enumerate(message["name"]):
                position = message["position"]
                self.joints[joint] = float(position[index]) if index < len(position) else math.nan
        elif kind == messages.NUMBERS:
            self.size = len(message["data"])


@dataclass(frozen=True, slots=True)
class Draft:
    """A robot file that is not written yet.

    Attributes:
        robot: Name of the robot.
        text: The robot file.
        urdf: URDF of the robot, if the network has one.
        summary: Sentence on the topics and their signals.
        notes: Sentences on what was chosen or guessed.
    """

    robot: str
    text: str
    urdf: str
    summary: str
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Limit:
    """Limits of a joint in a URDF [rad or m, rad/s or m/s]."""

    low: float
    high: float
    rate: float
    slides: bool


def draft(network: Network, robot: str, listen: float = LISTEN) -> Draft:
    """Listen to a ROS 2 network and draft a robot file.

    Args:
        network: Router, domain and distribution.
        robot: Name of the robot.
        listen: Time to listen [s].

    Raises:
        ServiceUnavailable: The router does not answer.
        ServiceError: No topic of a known type has messages.
    """
    heard: dict[str, tuple[str, Heard]] = {}
    urdfs: list[str] = []
    with Node("/gemuco_init", network) as node:
        entities = [one for one in node.graph.entities() if not one.node.endswith("/gemuco")]
        for topic, kind in sorted({(one.topic, one.type) for one in entities if one.kind is Kind.PUBLISHER}):
            if kind in READABLE:
                heard[topic] = (kind, Heard())
                node.subscribe(topic, kind, _taker(kind, heard[topic][1]))
        described = [one.topic for one in entities if one.topic.endswith("/robot_description")]
        for topic in dict.fromkeys(described):
            node.subscribe(topic, TEXT, lambda sample: urdfs.append(_text(sample)), is_latched=True)
        time.sleep(listen)
    if not any(part.count for _, part in heard.values()):
        raise ServiceError(_nothing(network, entities))
    limits = _limits(urdfs[0]) if urdfs else {}
    commands = [one for one in entities if one.kind is Kind.SUBSCRIPTION and one.type == messages.TRAJECTORY]
    return _draft(network, robot, heard, limits, commands, urdfs[0] if urdfs else "")


def _nothing(network: Network, entities: Sequence[Entity]) -> str:
    kinds = sorted({f"{one.topic} ({one.type or 'unknown type'})" for one in entities if one.kind is Kind.PUBLISHER})
    there = f"There are: {', '.join(kinds)}." if kinds else "There are no topics."
    return (
        f"No topic of the ROS domain {network.domain} at {network.router} has messages of the types "
        f"{', '.join(READABLE)}. {there} Are the domain and --ros-distro right?"
    )


def _taker(kind: str, heard: Heard) -> Any:
    def take(sample: zenoh.Sample) -> None:
        try:
            heard.take(kind, sample.payload.to_bytes())
        except cdr.BadBytes:
            heard.size = 0  # a topic without readable messages is left out

    return take


def _text(sample: zenoh.Sample) -> str:
    return str(cdr.decode(TEXT, sample.payload.to_bytes())["data"])


def _limits(urdf: str) -> dict[str, _Limit]:
    """Return joint -> its limits in a URDF; empty if it cannot be read."""
    try:
        root = root_of(urdf)
    except Tree.ParseError:
        return {}
    limits = {}
    for joint in root.findall("joint"):
        limit, kind = joint.find("limit"), joint.get("type")
        if limit is None or kind not in ("revolute", "continuous", "prismatic"):
            continue
        low, high, rate = (float(limit.get(name, "nan")) for name in ("lower", "upper", "velocity"))
        limits[joint.get("name", "")] = _Limit(low, high, rate, kind == "prismatic")
    return limits


def _draft(
    network: Network,
    robot: str,
    heard: dict[str, tuple[str, Heard]],
    limits: dict[str, _Limit],
    commands: Sequence[Entity],
    urdf: str,
) -> Draft:
    signals: dict[str, dict[str, Any]] = {}
    notes: list[str] = []
    for topic, (kind, part) in heard.items():
        if not part.count:
            notes.append(f"{topic} ({kind}) was silent and is left out.")
            continue
        for name, signal in _signals(topic, kind, part, limits):
            while name in signals:
                name = f"{name}_2"
            stale = 2.0 if math.isinf(part.period) else max(LEAST, round(PERIODS * part.period, 3))
            signals[name] = signal | {"source": "ros2", "topic": topic, "stale_after": stale}
    commanded = next((name for name in signals if name.endswith("position")), next(iter(signals)))
    joints = {joint: place for _, part in heard.values() for joint, place in part.joints.items()}
    body: dict[str, Any] = {
        "robot": robot,
        "description": f"Robot whose drivers are ROS 2 nodes, {len(signals)} signals.",
        "ros2": {"router": network.router, "domain": network.domain, "distribution": network.distribution},
        "signals": signals,
        "command": {"signal": commanded, "time_to_live": 0.2, "hold": 1.0},
    }
    if signals[commanded]["unit"] in ("rad", "m") and signals[commanded]["field"] == "position":
        body["limits"] = {commanded: _limit_of(signals[commanded]["elements"], joints, limits, notes)}
        _add_command(body["command"], commands, notes)
    body["rates"] = {"hal": 100, "estimation": 100, "control": 50, "anomaly": 50, "update": 10}
    if urdf:
        body["urdf"] = f"{robot}.urdf"
    listed = yaml.safe_dump(body, sort_keys=False, default_flow_style=None, width=110)
    elements = sum(len(signal["elements"]) for signal in signals.values())
    topics = len({signal["topic"] for signal in signals.values()})
    summary = f"{len(signals)} signals with {elements} elements from {topics} topics."
    return Draft(robot, HEAD.format(domain=network.domain) + listed, urdf, summary, tuple(notes))


def _signals(topic: str, kind: str, heard: Heard, limits: dict[str, _Limit]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the signals of one topic with their names."""
    base = ros_name(topic.strip("/").replace("/", "_")).lower()
    if kind == messages.JOINT_STATE:
        prefix = "" if topic.endswith("/joint_states") else f"{base}_"
        sliding = [joint for joint in heard.joints if joint in limits and limits[joint].slides]
        turning = [joint for joint in heard.joints if joint not in sliding]
        for group, units, joints in (("joint", JOINT_UNITS, turning), ("slide", SLIDING_UNITS, sliding)):
            for part, unit in units.items():
                if joints and part in heard.fields:
                    yield f"{prefix}{group}_{part}", {"unit": unit, "elements": sorted(joints), "field": part}
    elif kind == messages.NUMBERS and heard.size:
        yield base, {"unit": "1", "elements": [f"e{index}" for index in range(heard.size)], "field": "data"}
    elif kind == messages.POINT:
        yield base, {"unit": "m", "elements": list(messages.AXES), "field": "point"}
    elif kind == messages.WRENCH:
        yield f"{base}_force", {"unit": "N", "elements": list(messages.AXES), "field": "force"}
        yield f"{base}_torque", {"unit": "N m", "elements": list(messages.AXES), "field": "torque"}


def _limit_of(
    elements: Sequence[str], joints: dict[str, float], limits: dict[str, _Limit], notes: list[str]
) -> dict[str, Any]:
    """Return the limits of the commanded signal: those of the URDF, else a little around the present posture."""
    ranges, guessed = [], []
    for joint in elements:
        here, limit = joints.get(joint, math.nan), limits.get(joint)
        if limit is not None and np.isfinite([limit.low, limit.high, limit.rate]).all() and limit.low < limit.high:
            ranges.append((limit.low, limit.high, limit.rate))
        else:
            guessed.append(joint)
            here = here if math.isfinite(here) else 0.0
            ranges.append((round(here - NARROW, 3), round(here + NARROW, 3), SLOW))
    if guessed:
        notes.append(
            f"No limits are known of {', '.join(guessed)}: {NARROW:g} to both sides of where they are, at {SLOW:g}/s."
        )
    low, high, rate = zip(*ranges, strict=True)
    return {"low": list(low), "high": list(high), "rate": min(rate)}


def _add_command(command: dict[str, Any], commands: Sequence[Entity], notes: list[str]) -> None:
    if not commands:
        notes.append("No node subscribes to a trajectory_msgs/JointTrajectory, so the robot is only measured.")
        return
    topic = commands[0].topic
    command |= {"topic": topic, "message": "JointTrajectory"}
    others = sorted({one.topic for one in commands} - {topic})
    more = f" Others: {', '.join(others)}." if others else ""
    notes.append(f"Commands go to {topic}, which node {commands[0].node} reads.{more}")
