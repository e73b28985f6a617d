"""Everything that was known of a robot at each moment of a recording, as a live view would have shown it."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from services.recording.reading import FileFacts, read
from services.watch.snapshot import Newest, RobotSnapshot
from services.wire import keys
from services.wire.messages import Anomaly, Applied, Estimates, Holder, Message, Sample, Status, Update

ALIVE = 2.5
"""A service whose status is older than this [s] was gone."""
SILENT = 10**9
"""After this time without a message [ns] one moment per second is written; the elements are old by then."""
FIELDS: dict[type[Message], str] = {
    Applied: "applied", Estimates: "estimate", Anomaly: "anomaly", Update: "update", Holder: "holder"
}  # fmt: skip
"""Each message is this part of a snapshot; samples are of the HAL or of a camera, statuses of a service."""
STREAMS = {"hal": "sample", "vision": "vision", "model": "estimate"}
"""The stream of each service is this part of a snapshot."""


def moments(
    robot: str, described: Mapping[str, Any], files: Sequence[FileFacts], rate: float
) -> Iterator[tuple[int, RobotSnapshot]]:
    """Yield time [ns since 1970] and everything that was known then, at most `rate` times a second."""
    newest: dict[str, tuple[Message, int]] = {}
    period, due, last_ns = round(1e9 / rate), 0, 0
    for recorded in read([file.path for file in files]):
        due = due or recorded.received_ns + period
        while due <= recorded.received_ns:
            yield due, _snapshot(robot, described, newest, due)
            due += period if due - last_ns < SILENT else max(period, SILENT)
        newest[recorded.key] = (recorded.message, recorded.received_ns)
        last_ns = recorded.received_ns
    if newest:
        yield due, _snapshot(robot, described, newest, due)


def _snapshot(
    robot: str, described: Mapping[str, Any], newest: dict[str, tuple[Message, int]], now_ns: int
) -> RobotSnapshot:
    parts: dict[str, Any] = {}
    statuses: dict[str, Newest[Status]] = {}
    for key, (message, received_ns) in newest.items():
        age = max(0.0, 1e-9 * (now_ns - received_ns))
        _, service, _ = keys.parse(key)
        if isinstance(message, Status):
            statuses[service] = Newest(message, age)
        elif isinstance(message, Sample):
            parts["vision" if service == "vision" else "sample"] = Newest(message, age)
        elif (field := FIELDS.get(type(message))) is not None:
            parts[field] = Newest(message, age)
    alive = {service for service, status in statuses.items() if status.age < ALIVE}
    # A status comes once a second only; a service whose stream arrives is alive before.
    alive |= {service for service, part in STREAMS.items() if part in parts and parts[part].is_fresh}
    return RobotSnapshot(robot=robot, alive=frozenset(alive), statuses=statuses, hal=described, **parts)
