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
from services.learning.collector import BUS, EPISODE, SampleLimits
from services.model.living_model import layout_of
from services.model.model_config import CollectConfig, collect_config
from services.recording.reading import FileFacts, facts_of, one_robot, read
from services.wire import keys
from services.wire.records import Sample

PAUSE = 1.0
"""After a gap of this length [s] between usable samples a new episode begins."""


@dataclass(slots=True)
class Selection:
    """Samples taken from recordings, and the reasons for leaving out the others.

    Attributes:
        dataset: The episodes.
        seen: Number of samples examined, at the rate of collecting.
        incomplete: Number of examined samples in which a device did not answer.
        outside: Element -> number of samples that were left out because this element was not measured or beyond its
            limits; only the first such element of a sample counts.
    """

    dataset: Dataset
    seen: int
    incomplete: int
    outside: Counter[str]

    def sentence(self) -> str:
        """Return one sentence on the used samples and the samples left out."""
        text = f"{len(self.dataset)} of {self.seen} samples are used"
        omissions = [f"{self.incomplete} were incomplete"] if self.incomplete else []
        if self.outside:
            element, count = self.outside.most_common(1)[0]
            worst = f"most often {element}, {count}"
            omissions.append(f"in {self.outside.total()} a value was not measured or beyond its limits ({worst})")
        return f"{text}; {', '.join(omissions)}." if omissions else f"{text}."


def is_recording(path: Path) -> bool:
    """Whether a file is a recording, judged by its name."""
    return path.suffix == ".mcap"


def select(robot: RobotConfig, paths: Iterable[Path], condition: str | None = None) -> Selection:
    """Return the samples of recordings that a model can be trained from.

    Args:
        robot: The robot file.
        paths: Recordings of this robot, in any order.
        condition: Condition of the body; None takes it from each recording.

    Raises:
        RecordingError: The files cannot be read.
        DatasetError: Another robot, other units, an unknown condition, or no usable sample.
    """
    files = facts_of(list(paths))
    recorded = one_robot(files)
    if recorded != robot.robot:
        raise DatasetError(f"These are recordings of '{recorded}', but the robot file is of '{robot.robot}'.")
    layout = layout_of(robot)
    selector = _Selector(robot, layout)
    for file in files:
        _check_signals(file, layout)
    for identity in dict.fromkeys(file.recording for file in files):
        own = [file for file in files if file.recording == identity]
        selector.take(own, condition or _condition(robot, own))
    selection = selector.selection()
    if not selection.dataset.episodes:
        raise DatasetError(f"These recordings hold no sample to train from: {selection.sentence()}")
    return selection


def _condition(robot: RobotConfig, files: Sequence[FileFacts]) -> str:
    condition = next((file.condition for file in files if file.condition), "")
    if not condition and robot.conditions:
        raise DatasetError(
            f"'{files[0].path}' does not name the condition under which it was recorded. Give it with --condition; the "
            f"robot file has {', '.join(robot.conditions)}."
        )
    return condition or BUS


def _check_signals(file: FileFacts, layout: Layout) -> None:
    listed = file.catalogue.signals
    for signal in layout.signals:
        if signal.name not in listed:
            raise DatasetError(f"Signal '{signal.name}' is not in '{file.path}'. It holds: {', '.join(listed)}.")
        recorded = listed[signal.name]
        if (recorded.unit, recorded.elements) != (signal.unit, signal.elements):
            raise DatasetError(
                f"Signal '{signal.name}' of '{file.path}' has the elements {', '.join(recorded.elements)} "
                f"[{recorded.unit or 'unit not known'}]; {', '.join(signal.elements)} [{signal.unit}] are expected."
            )


class _Selector:
    """Selection of episodes from the samples of recordings."""

    def __init__(self, robot: RobotConfig, layout: Layout) -> None:
        self._robot, self._layout = robot, layout
        self._limits = SampleLimits(robot, layout)
        self._rate = (collect_config(robot) if robot.collect else CollectConfig()).rate
        self._episodes: list[Episode] = []
        self._seen = self._incomplete = 0
        self._outside: Counter[str] = Counter()

    def take(self, files: Sequence[FileFacts], condition: str) -> None:
        """Add the episodes of one recording."""
        longest = max(2, round(EPISODE * self._rate))
        rows: list[np.ndarray] = []
        last: tuple[int, int] | None = None
        for received_ns, boot, row in self._rows(files):
            goes_on = (
                last is not None and last[1] == boot and (received_ns - last[0]) * 1e-9 < max(PAUSE, 2 / self._rate)
            )
            if rows and (not goes_on or len(rows) >= longest):
                self._end(rows, condition)
                rows = []
            rows.append(row)
            last = received_ns, boot
        self._end(rows, condition)

    def selection(self) -> Selection:
        """Return the samples taken so far."""
        return Selection(Dataset(self._layout, tuple(self._episodes)), self._seen, self._incomplete, self._outside)

    def _end(self, rows: list[np.ndarray], condition: str) -> None:
        if len(rows) > 1:
            self._episodes.append(Episode(condition, self._layout.split(np.array(rows))))

    def _rows(self, files: Sequence[FileFacts]) -> Iterator[tuple[int, int, np.ndarray]]:
        """Yield arrival [ns], boot and values of the usable samples, at the rate of collecting."""
        period, due = round(1e9 / self._rate), 0
        seen: tuple[int, Sample] | None = None
        hal, vision = keys.sample(self._robot.robot), keys.vision(self._robot.robot)
        for recorded in read([file.path for file in files], [hal, vision]):
            sample = recorded.message
            assert isinstance(sample, Sample)
            if recorded.key == vision:
                seen = recorded.received_ns, sample
                continue
            if recorded.received_ns < due:
                continue
            due = due + period if recorded.received_ns - due < period else recorded.received_ns + period
            self._seen += 1
            if not sample.complete:
                self._incomplete += 1
                continue
            row = self._layout.join(self._values(sample, recorded.received_ns, seen))
            usable = self._limits.usable(row)
            if usable.all():
                yield recorded.received_ns, sample.boot, row
            else:
                self._outside[self._layout.element(int(np.argmin(usable)))] += 1

    def _values(self, sample: Sample, now_ns: int, seen: tuple[int, Sample] | None) -> dict[str, np.ndarray]:
        """Return the fresh values of a sample of the HAL and the last one of the camera; stale values are NaN."""
        values: dict[str, np.ndarray] = {}
        for name in self._layout.names:
            source, waited = sample, 0.0
            if name in self._robot.seen:
                if seen is None:
                    continue
                source, waited = seen[1], (now_ns - seen[0]) * 1e-9
            if name in source.values:
                fresh = source.valid[name] & (source.age[name] + waited <= self._robot.signals[name].stale_after)
                values[name] = np.where(fresh, source.values[name], np.nan)
        return values
