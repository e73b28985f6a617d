"""Recordings as data to train from: samples that are complete and within limits, at the rate of `gemuco collect`."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.errors import DatasetError
from gemuco.signals import Layout
from hal.config import RobotConfig
from services.learning.collector import BUS, EPISODE, Within
from services.model.living_model import layout_of
from services.model.model_config import CollectConfig, collect_config
from services.recording.reading import About, about, one_robot, read
from services.wire import keys
from services.wire.records import Sample

PAUSE = 1.0
"""A gap between samples that count [s] after which a new episode begins."""


@dataclass(slots=True)
class Picked:
    """What was taken from recordings, and why the rest was not.

    Attributes:
        dataset: The episodes.
        seen: Samples that were due at the rate of collecting.
        incomplete: Of those, such that some device did not answer in.
        outside: Element -> samples in which it was the first that was not measured or beyond its limits.
    """

    dataset: Dataset
    seen: int
    incomplete: int
    outside: Counter[str]

    def sentence(self) -> str:
        """What was taken and what was left out, for a person."""
        text = f"{len(self.dataset)} of {self.seen} samples are used"
        left = [f"{self.incomplete} were incomplete"] if self.incomplete else []
        if self.outside:
            element, count = self.outside.most_common(1)[0]
            worst = f"most often {element}, {count}"
            left.append(f"in {self.outside.total()} a value was not measured or beyond its limits ({worst})")
        return f"{text}; {', '.join(left)}." if left else f"{text}."


def is_recording(path: Path) -> bool:
    """Whether a file of data is a recording, by its name."""
    return path.suffix == ".mcap"


def pick(robot: RobotConfig, paths: Iterable[Path], condition: str | None = None) -> Picked:
    """The samples of recordings that a model can be trained from.

    Args:
        robot: The robot file.
        paths: Recordings of this robot, in any order.
        condition: How the body was; as each recording tells if None.

    Raises:
        RecordingError: The files cannot be read.
        DatasetError: They are of another robot or in other units, do not tell the condition, or nothing is usable.
    """
    files = about(list(paths))
    recorded = one_robot(files)
    if recorded != robot.robot:
        raise DatasetError(f"These are recordings of '{recorded}', and the robot file is that of '{robot.robot}'.")
    layout = layout_of(robot)
    picking = _Picking(robot, layout)
    for file in files:
        _check_signals(file, layout)
    for identity in dict.fromkeys(file.recording for file in files):
        own = [file for file in files if file.recording == identity]
        picking.take(own, condition or _condition(robot, own))
    found = picking.found()
    if not found.dataset.episodes:
        raise DatasetError(f"Nothing in these recordings can be trained from: {found.sentence()}")
    return found


def _condition(robot: RobotConfig, files: Sequence[About]) -> str:
    told = next((file.condition for file in files if file.condition), "")
    if not told and robot.conditions:
        raise DatasetError(
            f"'{files[0].path}' does not tell under which condition it was recorded. Say it with --condition; those of "
            f"the robot file are {', '.join(robot.conditions)}."
        )
    return told or BUS


def _check_signals(file: About, layout: Layout) -> None:
    listed = file.catalogue.signals
    for signal in layout.signals:
        if signal.name not in listed:
            raise DatasetError(f"Signal '{signal.name}' is not in '{file.path}'. It holds: {', '.join(listed)}.")
        there = listed[signal.name]
        if (there.unit, there.elements) != (signal.unit, signal.elements):
            raise DatasetError(
                f"Signal '{signal.name}' of '{file.path}' has the elements {', '.join(there.elements)} "
                f"[{there.unit or 'unit not known'}]; {', '.join(signal.elements)} [{signal.unit}] are wanted."
            )


class _Picking:
    """Episodes, as they grow."""

    def __init__(self, robot: RobotConfig, layout: Layout) -> None:
        self._robot, self._layout = robot, layout
        self._within = Within(robot, layout)
        self._rate = (collect_config(robot) if robot.collect else CollectConfig()).rate
        self._stale = {name: robot.signals[name].stale_after for name in robot.seen}
        self._episodes: list[Episode] = []
        self._seen = self._incomplete = 0
        self._outside: Counter[str] = Counter()

    def take(self, files: Sequence[About], condition: str) -> None:
        """Add the episodes of one recording."""
        most = max(2, round(EPISODE * self._rate))
        rows: list[np.ndarray] = []
        last: tuple[int, int] | None = None
        for received_ns, boot, row in self._rows(files):
            goes_on = (
                last is not None and last[1] == boot and (received_ns - last[0]) * 1e-9 < max(PAUSE, 2 / self._rate)
            )
            if rows and (not goes_on or len(rows) >= most):
                self._end(rows, condition)
                rows = []
            rows.append(row)
            last = received_ns, boot
        self._end(rows, condition)

    def found(self) -> Picked:
        """What was taken so far."""
        return Picked(Dataset(self._layout, tuple(self._episodes)), self._seen, self._incomplete, self._outside)

    def _end(self, rows: list[np.ndarray], condition: str) -> None:
        if len(rows) > 1:
            self._episodes.append(Episode(condition, self._layout.split(np.array(rows))))

    def _rows(self, files: Sequence[About]) -> Iterator[tuple[int, int, np.ndarray]]:
        """Arrival, boot and values of the samples that count, at the rate of collecting."""
        period, due = round(1e9 / self._rate), 0
        seen: tuple[int, Sample] | None = None
        hal, vision = keys.sample(self._robot.robot), keys.vision(self._robot.robot)
        for one in read([file.path for file in files], [hal, vision]):
            sample = one.message
            assert isinstance(sample, Sample)
            if one.key == vision:
                seen = one.received_ns, sample
                continue
            if one.received_ns < due:
                continue
            due = due + period if one.received_ns - due < period else one.received_ns + period
            self._seen += 1
            if not sample.complete:
                self._incomplete += 1
                continue
            row = self._layout.join(self._values(sample, one.received_ns, seen))
            counts = self._within.counts(row)
            if counts.all():
                yield one.received_ns, sample.boot, row
            else:
                self._outside[self._layout.element(int(np.argmin(counts)))] += 1

    def _values(self, sample: Sample, now_ns: int, seen: tuple[int, Sample] | None) -> dict[str, np.ndarray]:
        found: dict[str, np.ndarray] = {}
        for name in self._layout.names:
            source, waited = sample, 0.0
            if name in self._stale:
                if seen is None:
                    continue
                source, waited = seen[1], (now_ns - seen[0]) * 1e-9
            if name in source.values:
                fresh = source.valid[name] & (source.age[name] + waited <= self._robot.signals[name].stale_after)
                found[name] = np.where(fresh, source.values[name], np.nan)
        return found
