"""Recordings of an arm that nobody needs to run: written in the recorder's way, at times that the test chooses."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from any_message import ARM

from services.recording.writer import Limits, RecordingWriter
from services.wire import keys, messages
from services.wire.records import Applied, Command, Sample

SECOND = 10**9
BEGIN = 1_790_000_000 * SECOND


def position(number: int) -> np.ndarray:
    """Joint angles [rad] of the n-th sample."""
    return np.array([0.5 * np.sin(0.1 * number), 0.3 * np.cos(0.23 * number)])


def a_sample(number: int, boot: int = 11, complete: bool = True) -> Sample:
    """The n-th sample, at 100 Hz; its tension follows from its angles."""
    angles = position(number)
    return Sample(
        stamp_ns=BEGIN + number * SECOND // 100, seq=number, boot=boot, cycle=number, source="can", complete=complete,
        values={"joint_position": angles, "muscle_tension": np.array([20.0 + 10.0 * angles.sum()])},
        age={"joint_position": np.full(2, 0.001), "muscle_tension": np.full(1, 0.002)},
        valid={"joint_position": np.ones(2, bool), "muscle_tension": np.ones(1, bool)},
    )  # fmt: skip


def record(
    path: Path,
    robot: str,
    count: int,
    condition: str = "",
    limits: Limits | None = None,
    make: Callable[[int], Sample] = a_sample,
    begin: int = 0,
) -> list[Path]:
    """Write so many samples of 100 Hz from a number on, set-points and commands with them; the files."""
    writer = RecordingWriter(path, robot, ARM, condition, limits)
    writer.open(BEGIN)
    for number in range(begin, begin + count):
        sample = make(number)
        now = sample.stamp_ns + 200_000
        signal, values = "muscle_tension", np.array([float(number)])
        applied = Applied(
            stamp_ns=now, seq=number, boot=sample.boot, cycle=number, mode="follow", signal=signal, desired=values,
            values=values, limited_by=["rate"], sender=77,
        )  # fmt: skip
        command = Command(seq=number, boot=77, signal=signal, values=values, cycle=number, hal_boot=sample.boot)
        writer.add(keys.sample(robot), now, messages.encode(sample))
        writer.add(keys.applied(robot), now + 50_000, messages.encode(applied))
        writer.add(keys.command(robot), now + 80_000, messages.encode(command))
        if number % 40 == 0:
            writer.commit(now)
    writer.finish(now)
    return writer.paths
