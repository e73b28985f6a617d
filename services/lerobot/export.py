"""Export of recordings as a dataset of LeRobot, version 3.0, with the marks of what was estimated.

A frame has a value of every element, and says whether it was measured. Where an element was neither measured nor
estimated there is no frame: the episode ends, and another one begins when all are known again.
"""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gemuco.writing import PART
from services.errors import RecordingError
from services.lerobot.layout import Writer
from services.moments import moments
from services.recording.reading import FileFacts, Paths, facts_of, one_robot
from services.watch.signal_rows import Kind, SignalRow, signal_rows
from services.watch.snapshot import RobotSnapshot, fresh

SHORTEST = 1.0
"""An episode lasts at least this long [s]; a shorter piece is left out."""
STALE = 3.0
"""A sample of the HAL that is older than this number of frames is no value of a frame."""
STATE, ESTIMATED, STD, ACTION = "observation.state", "observation.estimated", "observation.std", "action"

Frame = dict[str, tuple[list[Any], list[str]]]
"""Feature -> its values at one moment, and the names of its elements."""


@dataclass(frozen=True, slots=True)
class Exported:
    """Result of an export: its folder, and the numbers of episodes, of frames, and of moments that were left out."""

    folder: Path
    episodes: int
    frames: int
    left_out: int

    def __str__(self) -> str:
        text = f"{self.episodes} episodes with {self.frames} frames in {self.folder}"
        if self.left_out:
            text += f"; {self.left_out} moments are left out, because a value was neither measured nor estimated"
        return f"{text}."


def export_lerobot(paths: Paths, out: Path, rate: int = 30, task: str = "move") -> Exported:
    """Write recordings as a dataset; every recording is at least one episode.

    Args:
        paths: Recordings of one robot, in any order.
        out: Folder of the dataset; an existing one is never replaced.
        rate: Frames per second.
        task: What the robot does, in words; LeRobot's policies may use it.

    Raises:
        RecordingError: The recordings cannot be read, no frame has all values, or the dataset cannot be written.
    """
    files = facts_of(paths)
    robot = one_robot(files)
    if out.exists():
        raise RecordingError(f"'{out}' exists and is not replaced. Name another folder.")
    part = out.with_name(out.name + PART)
    shutil.rmtree(part, ignore_errors=True)
    left_out = 0
    try:
        writer = Writer(part, robot, rate, task)
        for identity in dict.fromkeys(file.recording for file in files):
            own = [file for file in files if file.recording == identity]
            for episode, missing in _episodes(robot, own, rate):
                left_out += missing
                if len(episode.get(STATE, ())) >= SHORTEST * rate:
                    writer.add(episode)
                else:
                    left_out += len(episode.get(STATE, ()))
        if not writer.frames:
            raise RecordingError(
                "No moment of these recordings has a value of every element, measured or estimated. Was the model "
                "running, and does the recording have `model` and `hal`?"
            )
        writer.close()
        part.rename(out)
    except OSError as error:
        raise RecordingError(f"'{out}' cannot be written: {error.strerror or error}.") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return Exported(out, writer.episodes, writer.frames, left_out)


def _episodes(robot: str, files: list[FileFacts], rate: int) -> Iterator[tuple[dict[str, Any], int]]:
    """Yield feature -> frames of an episode, and the number of moments left out before it."""
    period, last_ns, missing = round(1e9 / rate), 0, 0
    frames: list[Frame] = []
    for now_ns, snapshot in moments(robot, files[0].described, files, rate):
        rows = [row for row in signal_rows(snapshot) if row.unit]
        is_stale = snapshot.sample is None or snapshot.sample.age > STALE / rate
        frame = None if is_stale else _frame(snapshot, rows)
        if frames and (frame is None or _names(frame) != _names(frames[0]) or now_ns - last_ns > 1.5 * period):
            yield _stacked(frames), missing
            frames, missing = [], 0
        if frame is None:
            missing += 1
            continue
        frames.append(frame)
        last_ns = now_ns
    yield _stacked(frames), missing


def _names(frame: Frame) -> dict[str, list[str]]:
    return {name: elements for name, (_, elements) in frame.items()}


def _frame(snapshot: RobotSnapshot, rows: list[SignalRow]) -> Frame | None:
    """Return the features of a moment; None if an element has no value.

    The state is the first signal in rad, which are the joints; each other signal is a feature of its own.
    """
    known = (Kind.MEASURED, Kind.ESTIMATED)
    if not rows or any(row.kind not in known or not np.isfinite(row.value) for row in rows):
        return None
    command = snapshot.hal.get("command", {}).get("signal", "")
    if not command and snapshot.applied is not None:
        command = snapshot.applied.message.signal
    values = {row.name: row.value for row in rows}
    names = [row.name for row in rows if row.signal == command]
    applied = fresh(snapshot.applied)
    sent = applied.values if applied is not None and applied.signal == command else np.full(len(names), np.nan)
    action = [
        float(value) if np.isfinite(value) else values[name] for name, value in zip(names, sent, strict=False)
    ]  # a robot that is not commanded stays where it is
    parts: dict[str, list[SignalRow]] = {}
    for row in rows:
        parts.setdefault(row.signal, []).append(row)
    joints = next((signal for signal, own in parts.items() if own[0].unit == "rad"), next(iter(parts)))
    frame = {STATE if signal == joints else f"observation.{signal}": own for signal, own in parts.items()}
    features = {name: ([row.value for row in own], [row.name for row in own]) for name, own in frame.items()}
    every = [row.name for row in rows]
    features[ESTIMATED] = [row.kind is Kind.ESTIMATED for row in rows], every
    features[STD] = [row.std if row.kind is Kind.ESTIMATED and np.isfinite(row.std) else 0.0 for row in rows], every
    if len(action) == len(names) > 0:
        features[ACTION] = action, names
    return features


def _stacked(frames: list[Frame]) -> dict[str, Any]:
    """Return feature -> array of all frames, shape (frames, n), and the names of their elements."""
    if not frames:
        return {}
    names = _names(frames[0])
    arrays = {
        name: np.array([frame[name][0] for frame in frames], np.bool_ if name == ESTIMATED else np.float32)
        for name in names
    }
    return {**arrays, "names": names}
