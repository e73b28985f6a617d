"""Recordings as Foxglove shows them: the channels of the live server, written from the recorded messages."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import foxglove

from gemuco.writing import PART
from services.errors import RecordingError
from services.foxglove.channels import RobotChannels
from services.foxglove.scene import Wires
from services.recording.reading import FileFacts, Paths, facts_of, one_robot, read
from services.watch.frames import Frames
from services.watch.snapshot import Newest, RobotSnapshot
from services.wire import keys
from services.wire.messages import Anomaly, Applied, Estimates, Holder, Message, Sample, Status, Update

SUFFIX = ".foxglove.mcap"
ALIVE = 2.5
"""A service whose status is older than this [s] was gone."""
SILENT = 10**9
"""After this time without a message [ns] one moment per second is written; the elements are old by then."""
FIELDS: dict[type[Message], str] = {
    Applied: "applied", Estimates: "estimate", Anomaly: "anomaly", Update: "update", Holder: "holder"
}  # fmt: skip
"""Each message is this part of a snapshot; samples are of the HAL or of a camera, statuses of a service."""

STREAMS = {"hal": "sample", "vision": "vision", "model": "estimate"}


def write_foxglove(
    paths: Paths, out: Path, frames: Frames | None = None, wires: Wires | None = None, rate: float = 30.0
) -> tuple[Path, int]:
    """Write a file with the channels of the live server.

    Args:
        paths: Recordings of one robot, in any order.
        out: Folder for the file, which is named after the first recording; an existing one is never replaced.
        frames: Frames of the robot's URDF; None without one.
        wires: Its wires.
        rate: Highest rate of each topic [Hz].

    Returns:
        The file, and the number of snapshots in it.

    Raises:
        RecordingError: The recordings cannot be read, or the file cannot be written.
    """
    files = facts_of(paths)
    robot = one_robot(files)
    path = out / f"{files[0].path.name.removesuffix('.mcap')}{SUFFIX}"
    part, count = path.with_name(path.name + PART), 0
    if path.exists():
        raise RecordingError(f"'{path}' exists and is not replaced. Name another folder.")
    context = foxglove.Context()
    try:
        out.mkdir(parents=True, exist_ok=True)
        channels = RobotChannels(robot, context, frames, wires)
        with foxglove.open_mcap(part, allow_overwrite=True, context=context):
            for now_ns, snapshot in snapshots(robot, files[0].described, files, rate):
                channels.publish(snapshot, now_ns)
                count += 1
        if not count:
            raise RecordingError("There are no messages in these recordings.")
        part.rename(path)
    except (OSError, RuntimeError) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f"'{path}' cannot be written: {error}.") from None
    finally:
        part.unlink(missing_ok=True)
    return path, count


def snapshots(
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
