"""Measured data from text files, described by a YAML file: signal and unit of every column, and settings of training.

A description names files and the columns of every signal, and has the sections `network`, `structure` and `training` of
a robot file (docs/tutorial.md). A fault in the description or the data is reported in one sentence.
"""

import csv
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import yaml
from pydantic import Field, ValidationError, model_validator

from gemuco.dataset import Dataset, Episode
from gemuco.errors import DatasetError
from gemuco.signals import Layout, Signal
from hal.config import Positive, Section, explain
from hal.errors import ConfigError
from services.model.model_config import ModelConfig, NetworkConfig, StructureConfig, TrainingConfig

CONVERSIONS = {
    "deg": ("rad", math.pi / 180.0),
    "deg/s": ("rad/s", math.pi / 180.0),
    "rpm": ("rad/s", math.pi / 30.0),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "mm/s": ("m/s", 1e-3),
    "g": ("kg", 1e-3),
    "ms": ("s", 1e-3),
    "mN": ("N", 1e-3),
    "kN": ("N", 1e3),
    "kgf": ("N", 9.80665),
    "N mm": ("N m", 1e-3),
}
"""Each unit in a file has this SI unit and this factor."""

MISSING = {"", "nan", "na", "none", "null"}
"""A cell with one of these texts, in lower case, was not measured."""

RANGE = re.compile(r"\{(\d+)\.\.(\d+)\}")


class ColumnsConfig(Section):
    """Place of a signal, or of the time, in the files."""

    columns: tuple[str | int, ...] = Field(min_length=1)
    """Names in the header, or numbers from 0 without a header; `board{0..15}` stands for sixteen names."""
    file: str | None = None
    """File in an episode's folder; None if the episode is a file."""

    @model_validator(mode="before")
    @classmethod
    def _one_column(cls, value: object) -> object:
        if isinstance(value, dict) and isinstance(value.get("columns"), str | int):
            return {**value, "columns": (value["columns"],)}
        return value

    def expanded(self) -> tuple[str, ...]:
        """Return the columns with every range written out."""
        return tuple(name for column in self.columns for name in _expanded(str(column)))


class MeasuredSignalConfig(ColumnsConfig):
    """A named vector of measured values."""

    unit: str
    written_in: str | None = None
    """Unit of the numbers in the file, if different from `unit`."""

    @model_validator(mode="after")
    def _units_fit(self) -> "MeasuredSignalConfig":
        if self.unit in CONVERSIONS:
            raise ValueError(
                f"'{self.unit}' is not the unit of the model; write unit: {CONVERSIONS[self.unit][0]} and "
                f"written_in: {self.unit}"
            )
        if self.written_in not in (None, self.unit) and CONVERSIONS.get(self.written_in or "", ("", 0))[0] != self.unit:
            known = ", ".join(f"{unit} to {si}" for unit, (si, _) in CONVERSIONS.items())
            raise ValueError(f"'{self.written_in}' cannot be converted to '{self.unit}'. Known: {known}")
        return self

    @property
    def scale(self) -> float:
        """Factor from a number of the file to `unit`."""
        return 1.0 if self.written_in in (None, self.unit) else CONVERSIONS[str(self.written_in)][1]


class TimeConfig(ColumnsConfig):
    """Stamp of every row [s], and the pause that ends an episode."""

    gap: Positive
    """A pause longer than this [s], or a step back, begins another episode."""


class MeasuredConfig(Section):
    """Description of measured data."""

    recording: str
    description: str = ""
    episodes: tuple[str, ...] = Field(min_length=1)
    """Patterns of files or folders; each match is at least one episode."""
    separator: str = Field(",", min_length=1, max_length=1)
    header: bool = True
    """Whether the first line names the columns."""
    cut_to_shortest: bool = False
    """Whether the files of a folder may have different numbers of rows; only rows that all files have are used."""
    signals: dict[str, MeasuredSignalConfig] = Field(min_length=1)
    time: TimeConfig | None = None
    """Time column; without it a file is one episode."""
    conditions: dict[str, str] = Field(default_factory=dict)
    """Condition of the body by pattern of an episode's name; if empty, all episodes have the same condition."""
    together: tuple[tuple[str, ...], ...] = ()
    """Groups of patterns of episodes' names. Repetitions of a motion become one episode; otherwise the held-out data
    could repeat a motion of the training data."""
    network: NetworkConfig = NetworkConfig()
    structure: StructureConfig = StructureConfig()
    training: TrainingConfig = TrainingConfig()

    @property
    def layout(self) -> Layout:
        """Signals and their elements."""
        signals = [
            Signal(name, len(part.expanded()), part.unit, part.expanded()) for name, part in self.signals.items()
        ]
        return Layout(tuple(signals))

    @property
    def model(self) -> ModelConfig:
        """Sections on the model, as in a robot file."""
        return ModelConfig(network=self.network, structure=self.structure, training=self.training)


def load_measured(path: Path) -> MeasuredConfig:
    """Read and check a description.

    Raises:
        ConfigError: The file is missing, is not YAML, or is not a description of data.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except OSError as error:
        raise ConfigError(f"The description '{path}' cannot be read: {error.strerror}.") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"'{path}' is not YAML: {str(error).splitlines()[0]}.") from None
    if not isinstance(content, dict):
        raise ConfigError(f"'{path}' is not a description of data: it needs recording, episodes and signals.")
    if isinstance(content.get("episodes"), str):
        content["episodes"] = (content["episodes"],)
    try:
        return MeasuredConfig.model_validate(content)
    except ValidationError as error:
        raise ConfigError(f"'{path}': {explain(error, MeasuredConfig)}") from None


def is_description(path: Path) -> bool:
    """Whether a YAML file describes measured data rather than a robot."""
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return False
    return isinstance(content, dict) and "recording" in content


def read_measured(config: MeasuredConfig, folder: Path) -> Dataset:
    """Read all episodes that a description names.

    Args:
        config: The description.
        folder: Folder in which its patterns are searched.

    Raises:
        DatasetError: No file matches, or a file differs from the description.
    """
    places: dict[Path, None] = {}
    for pattern in config.episodes:
        matches = sorted(folder.glob(pattern), key=_natural)
        if not matches:
            raise DatasetError(f"Nothing in '{folder}' matches '{pattern}'. Is this the folder of the recording?")
        places.update(dict.fromkeys(matches))
    episodes = [(place.name, episode) for place in places for episode in _episodes(config, place)]
    return Dataset(config.layout, _together(config, episodes))


def _together(config: MeasuredConfig, episodes: list[tuple[str, Episode]]) -> tuple[Episode, ...]:
    """Return the episodes with every group joined into one."""
    merged: list[Episode] = []
    remaining = dict(enumerate(episodes))
    for group in config.together:
        chosen = [i for i, (name, _) in remaining.items() if any(fnmatch(name, pattern) for pattern in group)]
        parts = [remaining.pop(index)[1] for index in chosen]
        if len({part.condition for part in parts}) != 1:
            fault = "have several conditions; they must have the same one" if parts else "do not exist"
            raise DatasetError(f"together: the episodes that match {', '.join(group)} {fault}.")
        values = {name: np.concatenate([part.values[name] for part in parts]) for name in config.signals}
        merged.append(Episode(parts[0].condition, values))
    return (*merged, *(episode for _, episode in remaining.values()))


def _episodes(config: MeasuredConfig, place: Path) -> Iterator[Episode]:
    """Yield the episodes of one file or folder."""
    tables: dict[str | None, _Table] = {}

    def columns(part: ColumnsConfig) -> np.ndarray:
        if part.file not in tables:
            tables[part.file] = _Table.read(place / part.file if part.file else place, config)
        return tables[part.file].columns(part.expanded())

    values = {name: columns(part) * part.scale for name, part in config.signals.items()}
    lengths = {len(array) for array in values.values()}
    stamps = columns(config.time)[:, 0] if config.time else None
    if stamps is not None:
        lengths.add(len(stamps))
    if len(lengths) > 1 and not config.cut_to_shortest:
        rows_of = ", ".join(f"{file or place.name} {len(table.cells)}" for file, table in tables.items())
        raise DatasetError(
            f"The files of '{place}' have different numbers of rows: {rows_of}. To use only rows that "
            "all files have, write cut_to_shortest: true."
        )
    cuts: np.ndarray = np.zeros(0, int)
    if stamps is not None and config.time is not None:
        steps = np.diff(stamps[: min(lengths)])
        cuts = np.flatnonzero((steps > config.time.gap) | (steps < 0.0)) + 1
    condition = _condition(config, place.name)
    for rows in np.split(np.arange(min(lengths)), cuts):
        yield Episode(condition, {name: array[rows] for name, array in values.items()})


def _condition(config: MeasuredConfig, name: str) -> str:
    for pattern, condition in config.conditions.items():
        if fnmatch(name, pattern):
            return condition
    if config.conditions:
        raise DatasetError(f"No condition is given for '{name}'. Patterns: {', '.join(config.conditions)}.")
    return config.recording


@dataclass(frozen=True, slots=True)
class _Table:
    """File with the index of each column and its cells as text."""

    path: Path
    indices: Mapping[str, int]
    cells: list[list[str]]
    first_line: int

    @classmethod
    def read(cls, path: Path, config: MeasuredConfig) -> "_Table":
        try:
            with path.open(newline="", encoding="utf-8-sig") as file:
                lines = [line for line in csv.reader(file, delimiter=config.separator) if line]
        except OSError as error:
            raise DatasetError(f"'{path}' cannot be read: {error.strerror}.") from None
        except (UnicodeDecodeError, csv.Error) as error:
            raise DatasetError(f"'{path}' is not a text file of separated values ({error}).") from None
        first = 1 if config.header else 0
        if len(lines) <= first:
            raise DatasetError(f"'{path}' is empty: it holds no row of data.")
        for number, line in enumerate(lines, start=1):
            if len(line) != len(lines[0]):
                raise DatasetError(
                    f"'{path}' line {number} has {len(line)} columns; the first has {len(lines[0])}. Is the separator "
                    f"'{config.separator}', and was the file written to its end?"
                )
        names = [name.strip() for name in lines[0]] if config.header else [str(i) for i in range(len(lines[0]))]
        return cls(path, {name: index for index, name in enumerate(names)}, lines[first:], first + 1)

    def columns(self, names: tuple[str, ...]) -> np.ndarray:
        """Return numbers, shape (rows, len(names)); NaN where a cell is empty."""
        for name in names:
            if name not in self.indices:
                known = list(self.indices)
                shown = ", ".join(known[:12]) + (f" and {len(known) - 12} more" if len(known) > 12 else "")
                raise DatasetError(f"'{self.path}' has no column '{name}'. Columns: {shown}.")
        numbers = np.empty((len(self.cells), len(names)))
        for column, name in enumerate(names):
            index = self.indices[name]
            for row, line in enumerate(self.cells):
                numbers[row, column] = self._number(line[index], name, row)
        return numbers

    def _number(self, cell: str, name: str, row: int) -> float:
        try:
            return float(cell)
        except ValueError:
            if cell.strip().lower() in MISSING:
                return math.nan
        raise DatasetError(
            f"'{self.path}' line {row + self.first_line}, column '{name}': '{cell[:30]}' is not a number. An empty "
            "cell means that no value was measured."
        )


def _expanded(column: str) -> Iterator[str]:
    match = RANGE.search(column)
    if match is None:
        yield column
        return
    for number in range(int(match[1]), int(match[2]) + 1):
        yield from _expanded(column[: match.start()] + str(number) + column[match.end() :])


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that puts `measurement_2` before `measurement_10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
