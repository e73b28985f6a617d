"""The topics of a robot: joint states, wrenches, points and other signals as ROS 2 messages, from each new sample."""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from services.ros2 import messages
from services.ros2.messages import Message
from services.ros2.names import ros_name
from services.ros2.node import Node, Publisher
from services.watch.frames import Frames
from services.watch.signal_rows import Kind, SignalRow
from services.watch.snapshot import RobotSnapshot, fresh

log = logging.getLogger(__name__)

TF, TF_STATIC = "/tf", "/tf_static"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
TEXT = "std_msgs/msg/String"

Rows = Sequence[SignalRow]
"""Rows of the elements of one signal."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic that carries one signal.

    Attributes:
        name: Full name.
        kind: ROS type.
        signal: Name of the signal.
        make: Makes a message of a time [ns since 1970] and the signal's rows; None if nothing is measured.
    """

    name: str
    kind: str
    signal: str
    make: Callable[[int, Rows], Message | None]


class Outgoing:
    """The topics of one robot.

    Args:
        node: The open node.
        robot: Name of the robot.
        frames: Frames of its URDF; None without one.

    Attributes:
        taken: Topic -> sentence, of topics that another node publishes and that are left to it.
    """

    def __init__(self, node: Node, robot: str, frames: Frames | None) -> None:
        self._node, self._frames = node, frames
        self._space = f"/{robot}"
        self._publishers: dict[str, Publisher] = {}
        self._topics: dict[str, list[Topic]] = {}
        self._last: dict[str, object] = {}
        self.taken: dict[str, str] = {}
        self._describe()

    @property
    def published(self) -> int:
        """Number of messages so far, of all topics."""
        return sum(publisher.published for publisher in self._publishers.values())

    def publish(self, snapshot: RobotSnapshot, rows: Rows) -> None:
        """Publish what is new: a message per topic for each new sample, nothing for a robot that is silent."""
        by_signal: dict[str, list[SignalRow]] = {}
        for row in rows:
            by_signal.setdefault(row.signal, []).append(row)
        for source, newest in (("hal", snapshot.sample), ("vision", snapshot.vision)):
            sample = fresh(newest)
            if sample is None or self._last.get(source) is sample:
                continue
            self._last[source] = sample
            here = {name: part for name, part in by_signal.items() if name in sample.values}
            self._publish_joints(sample.stamp_ns, here)
            for name, part in here.items():
                for topic in self._topics_of(name, part):
                    self._put(topic.name, topic.kind, topic.make(sample.stamp_ns, part))
        estimate = fresh(snapshot.estimate)
        if estimate is not None and self._last.get("model") is not estimate:
            self._last["model"] = estimate
            joints = _joints(
                {
                    name: list(zip((row.element for row in by_signal.get(name, ())), values, strict=False))
                    for name, values in estimate.values.items()
                }
            )
            message = messages.joint_state(estimate.stamp_ns, joints)
            self._put(f"{self._space}/joint_states_estimated", messages.JOINT_STATE, message)

    def check_names(self) -> None:
        """Look again at the topics that others publish; call it once a second."""
        for topic in self.taken.copy():
            if not self._node.graph.publishers(topic):
                del self.taken[topic]

    def doubled(self) -> list[str]:
        """Return sentences on topics of which another node became a publisher too."""
        return [
            f"Topic '{topic}' has another publisher, node '{others[0].node}'."
            for topic in self._publishers
            if topic.startswith(self._space) and (others := self._node.graph.publishers(topic))
        ]

    def _describe(self) -> None:
        """Publish the URDF and its fixed frames, for all subscribers that will come."""
        if self._frames is None:
            return
        self._put(f"{self._space}/robot_description", TEXT, {"data": self._frames.text}, is_latched=True)
        fixed = [_stamped(frame, 0) for frame in self._frames.fixed()]
        if fixed:
            self._put(TF_STATIC, TF_MESSAGE, {"transforms": fixed}, is_latched=True)

    def _publish_joints(self, stamp_ns: int, by_signal: dict[str, list[SignalRow]]) -> None:
        measured = {
            name: [(row.element, row.value) for row in part if row.kind is Kind.MEASURED]
            for name, part in by_signal.items()
        }
        joints = _joints(measured)
        self._put(f"{self._space}/joint_states", messages.JOINT_STATE, messages.joint_state(stamp_ns, joints))
        if self._frames is not None:
            positions = {name: values["position"] for name, values in joints.items() if "position" in values}
            moved = [_stamped(frame, stamp_ns) for frame in self._frames.moved(positions)]
            if moved:
                self._put(TF, TF_MESSAGE, {"transforms": moved})

    def _topics_of(self, signal: str, rows: Rows) -> list[Topic]:
        """Return the topics of a signal, which its first rows define."""
        if signal in messages.JOINTS:
            return []
        if signal not in self._topics:
            self._topics[signal] = list(_topics(self._space, signal, rows))
        return self._topics[signal]

    def _put(self, topic: str, kind: str, message: Message | None, *, is_latched: bool = False) -> None:
        """Publish a message; the first one makes the publisher, unless another node has the topic."""
        if message is None or topic in self.taken:
            return
        publisher = self._publishers.get(topic)
        if publisher is None:
            others = self._node.graph.publishers(topic) if topic.startswith(self._space) else []
            if others:
                self.taken[topic] = f"Topic '{topic}' is published by node '{others[0].node}' and is left to it."
                log.warning("%s", self.taken[topic])
                return
            publisher = self._publishers[topic] = self._node.publisher(topic, kind, is_latched=is_latched)
        publisher.put(message)


def _joints(values: Mapping[str, Sequence[tuple[str, float]]]) -> dict[str, dict[str, float]]:
    """Return joint -> field -> value, of signal -> elements with their values; unknown values are left out.

    If the robot has joint positions, a joint without a position is left out: readers expect one.
    """
    joints: dict[str, dict[str, float]] = {}
    for signal, field in messages.JOINTS.items():
        for element, value in values.get(signal, ()):
            is_joint = field == "position" or element in joints or "joint_position" not in values
            if is_joint and math.isfinite(value):
                joints.setdefault(element, {})[field] = float(value)
    return joints


def _topics(space: str, signal: str, rows: Rows) -> Iterable[Topic]:
    """Return the topics of a signal that is not of joints: points, wrenches of load cells, plain numbers."""
    elements, unit = tuple(row.element for row in rows), rows[0].unit
    place = f"{space}/{ros_name(signal)}"
    if unit == "m" and elements == messages.AXES:
        yield Topic(place, messages.POINT, signal, _point)
    elif elements == messages.FORCES:
        yield Topic(place, messages.WRENCH, signal, _wrench)
    elif unit == "N":
        for index, element in enumerate(elements):
            yield Topic(f"{place}/{ros_name(element)}", messages.WRENCH, signal, _cell(index))
    else:
        yield Topic(place, messages.NUMBERS, signal, _numbers)


def _values(rows: Rows) -> list[float]:
    """Return measured values; NaN for the others."""
    return [row.value if row.kind is Kind.MEASURED else math.nan for row in rows]


def _point(stamp_ns: int, rows: Rows) -> Message | None:
    values = _values(rows)
    return messages.point(stamp_ns, "", values) if all(map(math.isfinite, values)) else None


def _wrench(stamp_ns: int, rows: Rows) -> Message | None:
    measured = {row.element: row.value for row in rows if row.kind is Kind.MEASURED}
    return messages.wrench(stamp_ns, rows[0].signal, measured) if measured else None


def _cell(index: int) -> Callable[[int, Rows], Message | None]:
    def make(stamp_ns: int, rows: Rows) -> Message | None:
        row = rows[index]
        return messages.wrench(stamp_ns, row.element, {"fx": row.value}) if row.kind is Kind.MEASURED else None

    return make


def _numbers(stamp_ns: int, rows: Rows) -> Message | None:
    values = _values(rows)
    return messages.numbers([row.element for row in rows], values) if any(map(math.isfinite, values)) else None


def _stamped(frame: Message, stamp_ns: int) -> Message:
    """Return a transform with its header."""
    rest = {name: value for name, value in frame.items() if name != "parent"}
    return {"header": messages.header(stamp_ns, frame["parent"]), **rest}
