"""The diagnostics of a robot: one status per element, loop and service, as `diagnostic_msgs/msg/DiagnosticArray`."""

import math
import time
from collections.abc import Iterator, Sequence

from services.ros2 import messages
from services.ros2.messages import Message
from services.watch.service_rows import Level, LoopRow, ServiceRow, service_rows
from services.watch.signal_rows import Kind, SignalRow
from services.watch.snapshot import RobotSnapshot
from services.watch.trouble import HEALTHY, troubles

DIAGNOSTICS = "/diagnostics"
DIAGNOSTIC_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
OK, WARN, ERROR, STALE = 0, 1, 2, 3
LEVELS = {
    Level.GOOD: OK,
    Level.NOTE: OK,
    Level.DEGRADED: WARN,
    Level.ANOMALY: WARN,
    Level.TROUBLE: ERROR,
    Level.GONE: STALE,
}
"""Level of a status by the severity of a trouble."""


def diagnostics(snapshot: RobotSnapshot, rows: Sequence[SignalRow], bridge: Message) -> Message:
    """Return the state of everything; `bridge` is the status of the bridge itself."""
    robot = snapshot.robot
    statuses = [
        _whole(snapshot, rows),
        *(element_status(robot, row) for row in rows),
        *(status for row in service_rows(snapshot) for status in _service(robot, row)),
        bridge,
    ]
    return {"header": messages.header(time.time_ns()), "status": statuses}


def states(rows: Sequence[SignalRow]) -> list[tuple[Kind, str]]:
    """Return a value that changes when an element is lost, estimated, distrusted or back."""
    return [(row.kind, row.distrust) for row in rows]


def _whole(snapshot: RobotSnapshot, rows: Sequence[SignalRow]) -> Message:
    """Return the status of the robot: its worst trouble, and the others as values."""
    all_troubles = troubles(snapshot, rows)
    worst = all_troubles[0] if all_troubles else HEALTHY
    values = {f"trouble {number}": str(trouble) for number, trouble in enumerate(all_troubles, 1)}
    values |= {"motors": snapshot.motors or "not known", "lease holder": snapshot.lease_holder}
    return messages.status(f"{snapshot.robot}: robot", snapshot.robot, LEVELS[worst.level], str(worst), values)


def element_status(robot: str, row: SignalRow) -> Message:
    """Return the status of one element, with its value if it is measured or estimated."""
    level, text = WARN, row.distrust
    if row.kind is Kind.MEASURED:
        level, text = OK, "measured"
    elif row.kind is Kind.ESTIMATED:
        text = f"estimated from {row.source}" if row.source else "estimated"
        text += f", {row.distrust}" if row.distrust else ""
    elif not row.distrust:
        level, text = (
            STALE,
            "not measured" if math.isinf(row.age) or math.isnan(row.age) else f"not measured for {row.age:.1f} s",
        )
    values: dict[str, object] = {"state": row.kind.value, "unit": row.unit}
    if row.kind in (Kind.MEASURED, Kind.ESTIMATED):
        values["value"] = row.value
    if row.kind is Kind.ESTIMATED:
        values |= {"std": row.std, "estimated from": row.source, "method": row.method}
    known = {"age [s]": row.age, "sureness": row.state, "reason": row.reason, "distrusted": row.distrust}
    values |= {key: value for key, value in known.items() if value not in ("", math.inf) and value == value}
    return messages.status(f"{robot}: {row.name}", robot, level, text, values)


def _service(robot: str, row: ServiceRow) -> Iterator[Message]:
    """Return the status of a service, and those of its loops while it is present."""
    text = f"{row.state}. {row.text}" if row.text else row.state
    values = {"state": row.state} | ({"age of status [s]": row.age} if math.isfinite(row.age) else {})
    level = STALE if row.state in ("silent", "gone", "absent") else LEVELS[row.level]
    yield messages.status(f"{robot}: {row.name} service", robot, level, text, values)
    if row.is_present:
        for loop in row.loops:
            yield _loop(robot, row.name, loop)


def _loop(robot: str, service: str, loop: LoopRow) -> Message:
    problems = [text for text, is_so in (("too slow", loop.is_slow), ("late", loop.is_late)) if is_so]
    values = {
        "rate [Hz]": loop.rate, "wanted rate [Hz]": loop.wanted, "late p50 [s]": loop.p50, "late p99 [s]": loop.p99,
        "latest [s]": loop.worst, "skipped ticks": int(loop.skipped), "busy": loop.busy,
    }  # fmt: skip
    name = f"{robot}: {service} loop {loop.name}"
    return messages.status(name, robot, WARN if problems else OK, " and ".join(problems) or "in time", values)
