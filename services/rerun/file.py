"""Recordings as rerun shows them: one .rrd file with the robot at every moment."""

from pathlib import Path

import rerun as rr

from gemuco.writing import PART
from services.errors import RecordingError
from services.moments import moments
from services.recording.reading import Paths, facts_of, one_robot
from services.rerun.picture import RobotPicture, blueprint
from services.watch.frames import Frames
from services.watch.shapes import Wires

SUFFIX = ".rrd"


def write_rerun(
    paths: Paths, out: Path, frames: Frames | None = None, wires: Wires | None = None, rate: float = 30.0
) -> tuple[Path, int]:
    """Write a file for rerun.

    Args:
        paths: Recordings of one robot, in any order.
        out: Folder for the file, which is named after the first recording; an existing one is never replaced.
        frames: Frames of the robot's URDF; None without one.
        wires: Its wires.
        rate: Moments per second [Hz].

    Returns:
        The file, and the number of moments in it.

    Raises:
        RecordingError: The recordings cannot be read, or the file cannot be written.
    """
    files = facts_of(paths)
    robot, described = one_robot(files), files[0].described
    path = out / f"{files[0].path.name.removesuffix('.mcap')}{SUFFIX}"
    part, count = path.with_name(path.name + PART), 0
    if path.exists():
        raise RecordingError(f"'{path}' exists and is not replaced. Name another folder.")
    try:
        out.mkdir(parents=True, exist_ok=True)
        stream = rr.RecordingStream(f"gemuco {robot}")
        units = {name: str(about["unit"]) for name, about in described["signals"].items()}
        stream.save(part, default_blueprint=blueprint(robot, units))
        picture = RobotPicture(robot, stream, frames, wires)
        for now_ns, snapshot in moments(robot, described, files, rate):
            picture.show(snapshot, now_ns)
            count += 1
        stream.disconnect()
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
