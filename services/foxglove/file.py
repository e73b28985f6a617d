"""Recordings as Foxglove shows them: the channels of the live server, written from the recorded messages."""

from pathlib import Path

import foxglove

from gemuco.writing import PART
from services.errors import RecordingError
from services.foxglove.channels import RobotChannels
from services.moments import moments
from services.recording.reading import Paths, facts_of, one_robot
from services.watch.frames import Frames
from services.watch.shapes import Wires

SUFFIX = ".foxglove.mcap"


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
            for now_ns, snapshot in moments(robot, files[0].described, files, rate):
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
