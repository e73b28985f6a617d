"""The channels of one robot: the same for a live server and for a file, made from snapshots of the robot."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import foxglove
from foxglove.channels import FrameTransformsChannel, JointStatesChannel, LogChannel, SceneUpdateChannel
from foxglove.messages import JointState, JointStates, Log, LogLevel, Timestamp

from services.foxglove.scene import RobotScene
from services.watch.fields import element, known, tension_limits
from services.watch.frames import Frames
from services.watch.service_rows import Level, service_rows
from services.watch.shapes import Wires
from services.watch.signal_rows import Kind, SignalRow, signal_rows
from services.watch.snapshot import RobotSnapshot, fresh
from services.watch.trouble import HEALTHY, Trouble, troubles, verdict

NUMBER, TEXT = {"type": "number"}, {"type": "string"}
ELEMENT = {
    "value": {**NUMBER, "description": "measured, or estimated if it is not measured"},
    "measured": {**NUMBER, "description": "the value, while it is measured"},
    "estimated": {**NUMBER, "description": "the value, while it is estimated"},
    "low": {**NUMBER, "description": "value - 1.645 std of an estimate"},
    "high": {**NUMBER, "description": "value + 1.645 std of an estimate"},
    "std": {**NUMBER, "description": "expected error of an estimate"},
    "age": {**NUMBER, "description": "time since it was measured [s]"},
    "kind": {**TEXT, "description": "measured, estimated, masked (neither) or old (no longer published)"},
    "state": {**TEXT, "description": "known, doubtful or unknown: whether an estimate is inside of what was learned"},
    "reason": {**TEXT, "description": "why it is hidden or doubtful"},
}
"""An element of a signal has these fields; a number that is not known is absent, and plots show a gap."""
JOINTS = {"joint_position": "position", "joint_velocity": "velocity", "joint_effort": "effort"}
"""These signals are fields of joint states."""
SCENE_EVERY, HEALTH_EVERY = 1.0, 0.5
"""The whole scene and the health are published at these intervals [s], so that every viewer that opens has them."""
LEVELS = {Level.GOOD: LogLevel.Info, Level.NOTE: LogLevel.Info, Level.DEGRADED: LogLevel.Warning}
"""Any other level is an error."""


class RobotChannels:
    """Everything of one robot, on channels whose topics begin with its name.

    Args:
        robot: Name of the robot.
        context: Context of the server or file that takes the messages.
        frames: Frames of its URDF; None without one.
        wires: Its wires.
    """

    def __init__(
        self, robot: str, context: foxglove.Context, frames: Frames | None = None, wires: Wires | None = None
    ) -> None:
        self._robot, self._context, self._scene = robot, context, RobotScene(frames, wires)
        self._transforms = FrameTransformsChannel(f"/{robot}/tf", context=context)
        self._shapes = SceneUpdateChannel(f"/{robot}/scene", context=context)
        self._measured = JointStatesChannel(f"/{robot}/joint_states", context=context)
        self._estimated = JointStatesChannel(f"/{robot}/joint_states_estimated", context=context)
        self._log = LogChannel(f"/{robot}/log", context=context)
        self._health = _json_channel(f"/{robot}/health", "gemuco.Health", _HEALTH, context)
        self._signals: dict[tuple[str, ...], foxglove.Channel] = {}
        self._last: dict[str, object] = {}
        self._kinds: dict[str, tuple[Kind, str]] = {}
        self._present: dict[str, Trouble] = {}
        self._scene_at = self._health_at = -math.inf

    def publish(self, snapshot: RobotSnapshot, now_ns: int) -> None:
        """Publish what is new in a snapshot at a time [ns since 1970].

        A robot that is silent has no new values: its elements are `old`, its links grey, and the log says so.
        """
        rows = [row for row in signal_rows(snapshot) if row.unit]
        is_new = self._is_new(snapshot)
        kinds = {row.name: (row.kind, row.distrust) for row in rows}
        is_other = kinds != self._kinds
        if is_new or is_other:
            self._put_values(snapshot, rows, now_ns)
        if is_other or 1e-9 * now_ns - self._scene_at >= SCENE_EVERY or (is_new and self._scene.shapes.has_wires):
            self._scene_at = 1e-9 * now_ns
            self._shapes.log(self._scene.update(rows, now_ns, tension_limits(snapshot)), log_time=now_ns)
        self._put_events(snapshot, rows, now_ns)
        self._kinds = kinds
        if 1e-9 * now_ns - self._health_at >= HEALTH_EVERY:
            self._health_at = 1e-9 * now_ns
            self._health.log(health(snapshot, rows), log_time=now_ns)

    def show_again(self) -> None:
        """Publish scene and health with the next snapshot, because a viewer has come."""
        self._scene_at = self._health_at = -math.inf

    def _is_new(self, snapshot: RobotSnapshot) -> bool:
        newest = {
            "hal": fresh(snapshot.sample), "vision": fresh(snapshot.vision), "model": fresh(snapshot.estimate)
        }  # fmt: skip
        is_new = any(message is not None and self._last.get(name) is not message for name, message in newest.items())
        self._last.update(newest)
        return is_new

    def _put_values(self, snapshot: RobotSnapshot, rows: Sequence[SignalRow], now_ns: int) -> None:
        self._scene.shapes.follow(rows)
        self._transforms.log(self._scene.transforms(now_ns), log_time=now_ns)
        for channel, kinds in ((self._measured, {Kind.MEASURED}), (self._estimated, {Kind.MEASURED, Kind.ESTIMATED})):
            channel.log(_joint_states([row for row in rows if row.kind in kinds], now_ns), log_time=now_ns)
        for signal in dict.fromkeys(row.signal for row in rows):
            own = [row for row in rows if row.signal == signal]
            self._channel_of(signal, own).log({row.element: element(row) for row in own}, log_time=now_ns)

    def _channel_of(self, signal: str, rows: Sequence[SignalRow]) -> foxglove.Channel:
        """Return the channel of a signal; one with other elements, as after a change of the robot file, is closed."""
        identity = (signal, rows[0].unit, *(row.element for row in rows))
        if identity not in self._signals:
            for other in [known for known in self._signals if known[0] == signal]:
                self._signals.pop(other).close()
            fields = {row.element: {"type": "object", "properties": ELEMENT} for row in rows}
            schema = {"type": "object", "description": f"{signal} [{rows[0].unit}]", "properties": fields}
            title = f"gemuco.{signal}"
            self._signals[identity] = _json_channel(f"/{self._robot}/{signal}", title, schema, self._context)
        return self._signals[identity]

    def _put_events(self, snapshot: RobotSnapshot, rows: Sequence[SignalRow], now_ns: int) -> None:
        """Log each element that is lost or back, and each trouble that begins or ends."""
        for row in rows:
            was, now = self._kinds.get(row.name), (row.kind, row.distrust)
            if was is not None and was != now:
                level = LogLevel.Info if row.kind is Kind.MEASURED else LogLevel.Warning
                because = f" ({row.distrust or row.reason})" if row.distrust or row.reason else ""
                self._say(level, row.signal, f"{row.name} is {row.kind}{because}; it was {was[0]}.", now_ns)
        present = {trouble.title: trouble for trouble in troubles(snapshot, rows)}
        for title, trouble in present.items():
            if title not in self._present:
                self._say(LEVELS.get(trouble.level, LogLevel.Error), "robot", str(trouble), now_ns)
        for title in self._present.keys() - present.keys():
            self._say(LogLevel.Info, "robot", f"Ended: {title}.", now_ns)
        self._present = present

    def _say(self, level: LogLevel, name: str, text: str, now_ns: int) -> None:
        stamp = Timestamp(now_ns // 1_000_000_000, now_ns % 1_000_000_000)
        self._log.log(Log(timestamp=stamp, level=level, name=f"{self._robot}.{name}", message=text), log_time=now_ns)


_HEALTH = {
    "type": "object",
    "properties": {
        "severity": {**NUMBER, "description": "0 good, 1 note, 2 degraded, 3 anomaly, 4 trouble, 5 gone"},
        "troubles": {"type": "array", "items": TEXT},
        "motors": TEXT,
        "lease": TEXT,
        "anomaly": {
            "type": "object",
            "properties": {"score": NUMBER, "threshold": NUMBER, "kind": TEXT, "blamed": TEXT},
        },
        "elements": {"type": "object", "properties": {kind.value: {"type": "integer"} for kind in Kind}},
        "loops": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "name": TEXT, "rate": NUMBER, "wanted": NUMBER, "late_p99": NUMBER, "skipped": NUMBER,
                },
            },
        },
    },
}  # fmt: skip


def health(snapshot: RobotSnapshot, rows: Sequence[SignalRow]) -> dict[str, Any]:
    """Return severity, troubles, motors, lease, anomaly, loops and numbers of elements; unknown numbers are absent."""
    present = troubles(snapshot, rows)
    judged = verdict(snapshot)
    return {
        "severity": float((present[0] if present else HEALTHY).level),
        "troubles": [str(trouble) for trouble in present],
        "motors": snapshot.motors or "not known",
        "lease": snapshot.lease_holder,
        "anomaly": {} if judged is None else {
            **known({"score": judged.score, "threshold": judged.threshold}),
            "kind": judged.kind, "blamed": judged.blamed,
        },
        "elements": {kind.value: sum(row.kind is kind for row in rows) for kind in Kind},
        "loops": [
            {"name": f"{service.name}.{loop.name}", **known({
                "rate": loop.rate, "wanted": loop.wanted, "late_p99": loop.p99, "skipped": float(loop.skipped),
            })}
            for service in service_rows(snapshot) if service.is_present for loop in service.loops
        ],
    }  # fmt: skip


def _joint_states(rows: Iterable[SignalRow], now_ns: int) -> JointStates:
    """Return the joints of these rows; a joint without a position is left out if others have one."""
    joints: dict[str, dict[str, float]] = {}
    for row in rows:
        if row.signal in JOINTS and math.isfinite(row.value):
            joints.setdefault(row.element, {})[JOINTS[row.signal]] = row.value
    has_positions = any("position" in fields for fields in joints.values())
    states = [
        JointState(name=name, **fields) for name, fields in joints.items() if "position" in fields or not has_positions
    ]
    return JointStates(timestamp=Timestamp(now_ns // 1_000_000_000, now_ns % 1_000_000_000), joints=states)


def _json_channel(topic: str, title: str, schema: Mapping[str, Any], context: foxglove.Context) -> foxglove.Channel:
    return foxglove.Channel(topic, schema={"title": title, **schema}, message_encoding="json", context=context)
