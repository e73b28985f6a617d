"""Measured data from the files that a description names: episodes of the rows that were measured."""

import logging
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.errors import DatasetError
from services.measured.alignment import aligned, by_signal, merged
from services.measured.description import ColumnsConfig, MeasuredConfig, TimeConfig
from services.measured.table import Table, counted
from services.measured.table_files import read_table

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Timed:
    """Episodes, the file or folder of each, and the number of their rows per second [Hz]; None if it is not known."""

    dataset: Dataset
    names: tuple[str, ...]
    rate: float | None


def read_measured(config: MeasuredConfig, folder: Path, note: Callable[[str], None] = logger.warning) -> Dataset:
    """Read all episodes that a description names; arguments and errors are those of `read_timed`."""
    return read_timed(config, folder, note).dataset


def read_timed(config: MeasuredConfig, folder: Path, note: Callable[[str], None] = logger.warning) -> Timed:
    """Read all episodes that a description names, with their names and rate.

    Args:
        config: The description.
        folder: Folder in which its patterns are searched.
        note: Called with each sentence on rows that were left out; logged as a warning if not given.

    Raises:
        DatasetError: No file matches, or a file differs from the description.
    """
    folder = Path(folder)
    places = _places(config, folder)
    reader = _Reader(config, note)
    episodes = [(place, episode) for place in places for episode in reader.episodes(place, reader.condition(place))]
    reader.check()
    names, joined = zip(*_together(config, episodes), strict=True)
    rate = 1.0 / float(np.median(reader.steps)) if reader.steps else None
    return Timed(Dataset(config.layout, joined), names, rate)


@dataclass(frozen=True, slots=True)
class _Place:
    """File or folder of an episode, and its name for patterns."""

    path: Path
    name: str

    def fits(self, pattern: str) -> bool:
        """Whether the pattern is of the name with or without its folders."""
        return fnmatch(self.path.name, pattern) or fnmatch(self.name, pattern)


def _places(config: MeasuredConfig, folder: Path) -> list[_Place]:
    places: dict[Path, None] = {}
    in_folders = any(part.file for part in config.signals.values())
    for pattern in config.episodes:
        try:
            matches = sorted(folder.glob(pattern), key=_natural)
        except (NotImplementedError, ValueError):
            raise DatasetError(
                f"episodes: '{pattern}' must be a pattern below the folder of the data, such as '*.csv'; "
                "name the folder with --data."
            ) from None
        if not matches:
            raise DatasetError(_unmatched(folder, pattern))
        places.update(dict.fromkeys(path for path in matches if path.is_dir() == in_folders or len(matches) == 1))
    return [_Place(path, path.relative_to(folder).as_posix()) for path in places]


def _unmatched(folder: Path, pattern: str) -> str:
    if not folder.is_dir():
        return f"There is no folder '{folder}'; name the folder of the data with --data."
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    holds = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    return (
        f"Nothing in '{folder}' matches '{pattern}'. Is this the folder of the recording? It holds "
        f"{holds or 'no file'}; name another with --data."
    )


def _together(config: MeasuredConfig, episodes: list[tuple[_Place, Episode]]) -> list[tuple[str, Episode]]:
    """Return the episodes and their names with every group joined into one."""
    merged: list[tuple[str, Episode]] = []
    remaining = dict(enumerate(episodes))
    for group in config.together:
        chosen = [i for i, (place, _) in remaining.items() if any(place.fits(pattern) for pattern in group)]
        parts = [remaining.pop(index)[1] for index in chosen]
        if len({part.condition for part in parts}) != 1:
            fault = "have several conditions; they must have the same one" if parts else "do not exist"
            raise DatasetError(f"together: the episodes that match {', '.join(group)} {fault}.")
        values = {name: np.concatenate([part.values[name] for part in parts]) for name in config.signals}
        merged.append((", ".join(group), Episode(parts[0].condition, values)))
    return [*merged, *((place.name, episode) for place, episode in remaining.values())]


@dataclass(slots=True)
class _Reader:
    """Episodes of the files of a description.

    Attributes:
        config: The description.
        note: Called with sentences on rows that were left out.
        used: Patterns of conditions that some file matches.
        seen: Number of rows of data; `kept` is the number after thinning out.
        steps: Usual time between the rows of each episode [s].
    """

    config: MeasuredConfig
    note: Callable[[str], None]
    used: set[str] = field(default_factory=set)
    seen: int = 0
    kept: int = 0
    steps: list[float] = field(default_factory=list)

    def condition(self, place: _Place) -> str:
        """Return the condition of a file or folder."""
        conditions = self.config.conditions
        for pattern, condition in conditions.items():
            if place.fits(pattern):
                self.used.add(pattern)
                return condition
        if conditions:
            raise DatasetError(
                f"No condition is given for '{place.name}'. Patterns: {', '.join(conditions)}; '*' is for all others."
            )
        return self.config.recording

    def check(self) -> None:
        """Note what was without effect in the description, or thinned out."""
        for pattern in self.config.conditions:
            if pattern not in self.used:
                self.note(f"conditions: '{pattern}' is of no episode, or an earlier pattern has them all.")
        if self.config.interpolate is not None:
            self.note(f"Interpolated: {self.kept} rows at {self.config.rate:g} Hz from {self.seen}.")
        elif self.kept < self.seen:
            self.note(f"Thinned out: {self.kept} of {self.seen} rows are used.")
        elif self.config.rate is not None:
            self.note(f"rate: {self.config.rate:g} Hz is not below the rate of the data; every row is used.")

    def episodes(self, place: _Place, condition: str) -> Iterator[Episode]:
        """Yield the episodes of one file or folder."""
        values, stamps, numbers = self._columns(place)
        known = np.any([np.isfinite(array).any(axis=1) for array in values.values()], axis=0)
        if stamps is not None:
            lost = int((known & ~np.isfinite(stamps)).sum())
            if lost:
                self.note(f"'{place.path}': {counted(lost, 'row')} without a stamp left out.")
            known &= np.isfinite(stamps)
        rows = np.flatnonzero(known)
        if not len(rows):
            raise DatasetError(
                f"'{place.path}' holds no row with a measured value{' and a stamp' * (stamps is not None)}."
            )
        starts = np.zeros(len(rows) - 1, bool)
        if stamps is not None and self.config.time is not None:
            steps = np.diff(stamps[rows])
            pause, back = self.config.time.pause(steps), 0.0
            if self.config.interpolate is not None:  # the usual step is that between two messages
                pause, back = self.config.time.gap or max(pause, self.config.interpolate), -self.config.interpolate
            starts |= (steps > pause) | (steps < back)
        if numbers is not None:
            starts |= np.diff(numbers[rows]) != 0.0
        for part in np.split(rows, np.flatnonzero(starts) + 1):
            if stamps is not None and self.config.interpolate is not None:
                yield self._interpolated(condition, stamps[part], {name: array[part] for name, array in values.items()})
                continue
            chosen = part[self._thinned(len(part), None if stamps is None else stamps[part])]
            self.seen, self.kept = self.seen + len(part), self.kept + len(chosen)
            if stamps is not None and len(chosen) > 1:
                self.steps.append(float(np.median(np.diff(stamps[chosen]))))
            yield Episode(condition, {name: array[chosen] for name, array in values.items()})

    def _interpolated(self, condition: str, stamps: np.ndarray, values: dict[str, np.ndarray]) -> Episode:
        """Return an episode of rows that hold some of the signals only, interpolated at the rate of the description."""
        rate, pause = self.config.rate, self.config.interpolate
        assert rate is not None and pause is not None  # the description demands both
        rows = aligned(stamps, np.concatenate(list(values.values()), axis=1), rate, pause)
        self.seen, self.kept = self.seen + len(stamps), self.kept + len(rows)
        self.steps.append(1.0 / rate)
        return Episode(condition, by_signal(rows, {name: part.shape[1] for name, part in values.items()}))

    def _thinned(self, count: int, stamps: np.ndarray | None) -> np.ndarray:
        """Return the indices of the rows of an episode that are used."""
        if self.config.rate is None or stamps is None:
            return np.arange(0, count, self.config.every)
        ticks = np.floor((stamps - stamps[0]) * self.config.rate + 1e-3)
        return np.flatnonzero(np.diff(ticks, prepend=-1.0) > 0.0)

    def _columns(self, place: _Place) -> tuple[dict[str, np.ndarray], np.ndarray | None, np.ndarray | None]:
        """Return values of every signal [its unit], shape (rows, n), stamps [s], shape (rows,), and episode numbers."""
        config, tables = self.config, self._tables(place)
        if config.interpolate is not None:
            return *self._merged(tables), None
        arrays = {name: self._of(tables, part) for name, part in config.signals.items()}
        stamps = None if config.time is None else self._of(tables, config.time)[0]
        numbers = None if config.episode is None else self._of(tables, config.episode)[0]
        others = [array for array in (stamps, numbers) if array is not None]
        lengths = {len(column) for columns in (*arrays.values(), others) for column in columns}
        if len(lengths) > 1 and not config.cut_to_shortest:
            rows_of = ", ".join(f"{file or place.path.name} {table.rows}" for file, table in tables.items())
            raise DatasetError(
                f"The columns of '{place.path}' have different numbers of rows: {rows_of}. To use only rows that "
                "all have, write cut_to_shortest: true."
            )
        rows = min(lengths)
        values = {
            name: np.stack([column[:rows] for column in columns], axis=1) * config.signals[name].scale
            for name, columns in arrays.items()
        }
        if stamps is not None and config.time is not None:
            stamps = config.time.seconds(stamps[:rows])
        return values, stamps, None if numbers is None else numbers[:rows]

    def _merged(self, tables: Mapping[str | None, Table]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return values of every signal and stamps of the rows of all files, NaN where a row is of another file."""
        parts: list[tuple[np.ndarray, np.ndarray]] = []
        sizes: dict[str, int] = {}
        for clock in self._clocks:
            own = {name: signal for name, signal in self.config.signals.items() if signal.file == clock.file}
            sizes |= {name: len(signal.expanded()) for name, signal in own.items()}
            columns = [c * signal.scale for signal in own.values() for c in self._of(tables, signal)]
            stamps = clock.seconds(self._of(tables, clock)[0])
            stamped = np.isfinite(stamps)
            parts.append((stamps[stamped], np.stack(columns, axis=1)[stamped]))
        stamps, values = merged(parts)
        arrays = by_signal(values, sizes)
        return {name: arrays[name] for name in self.config.signals}, stamps

    @property
    def _clocks(self) -> list[TimeConfig]:
        """Places of the time: in every file if each has stamps of its own."""
        config = self.config
        if config.time is None or config.interpolate is None:
            return [] if config.time is None else [config.time]
        files = dict.fromkeys(signal.file for signal in config.signals.values())
        return [config.time.model_copy(update={"file": file}) for file in files]

    def _tables(self, place: _Place) -> dict[str | None, Table]:
        """Return the tables of a file or folder with the columns that the description names."""
        config = self.config
        clocks = {clock.file: clock.expanded() for clock in self._clocks}
        episode = () if config.episode is None else (config.episode,)
        wanted: dict[str | None, dict[str, None]] = {}
        for part in (*config.signals.values(), *self._clocks, *episode):
            wanted.setdefault(part.file, {}).update(dict.fromkeys(part.expanded()))
        tables: dict[str | None, Table] = {}
        for file, columns in wanted.items():
            path = place.path / file if file else place.path
            tables[file] = read_table(path, config.style, tuple(columns), clocks.get(file, ()))
            for sentence in tables[file].notes:
                self.note(sentence)
        return tables

    @staticmethod
    def _of(tables: Mapping[str | None, Table], part: ColumnsConfig) -> list[np.ndarray]:
        return [tables[part.file].columns[name] for name in part.expanded()]


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that puts `measurement_2` before `measurement_10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
