"""Description of measured data in a YAML file: signal and unit of every column, and settings of training.

A description names files and the columns of every signal, and has the sections `network`, `structure` and `training` of
a robot file (docs/tutorial.md). A fault in the description or the data is reported in one sentence.
"""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from gemuco.signals import Layout, Signal
from hal.calibration.units import check_units, factor
from hal.config import Positive, Section
from hal.errors import ConfigError
from hal.reading.mistakes import explain, parse_yaml
from services.measured.text_table import TextStyle
from services.model.model_config import Count, ModelConfig, NetworkConfig, StructureConfig, TrainingConfig

USUAL = 10.0
"""Without a `gap`, a pause of this many usual steps begins another episode."""
RANGE = re.compile(r"\{(\d+)\.\.(\d+)\}")
SEPARATORS = {"tab": "\t", "\\t": "\t", "space": " ", "comma": ",", "semicolon": ";"}
"""A separator may be given by one of these words."""

EXAMPLES = {"signals": "{joint: {unit: rad, columns: q}}", "conditions": '{"run_1*": light, "run_2*": heavy}'}
"""These keys hold mappings such as these."""


def _text(value: object) -> object:
    """Return a number of YAML as the text it was written as."""
    return str(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


Text = Annotated[str, BeforeValidator(_text)]
"""A number in YAML is text here: `unit: 1`."""


class ColumnsConfig(Section):
    """Place of a signal, or of the time, in the files."""

    columns: tuple[str | int, ...] = Field(min_length=1)
    """Names in the header, or numbers from 0; `board{0..15}` stands for sixteen names."""
    file: str | None = None
    """File in an episode's folder; None if the episode is a file."""

    @model_validator(mode="before")
    @classmethod
    def _one_column(cls, value: object) -> object:
        if isinstance(value, str | int):
            return {"columns": (value,)}
        if isinstance(value, dict) and isinstance(value.get("columns"), str | int):
            return {**value, "columns": (value["columns"],)}
        return value

    @model_validator(mode="after")
    def _columns_exist(self) -> "ColumnsConfig":
        if "" in self.expanded() or not self.expanded():
            raise ValueError("columns need names or numbers; a range counts up, such as {0..5}")
        return self

    def expanded(self) -> tuple[str, ...]:
        """Return the columns with every range written out."""
        return tuple(name for column in self.columns for name in _expanded(str(column)))


class MeasuredSignalConfig(ColumnsConfig):
    """A named vector of measured values."""

    unit: Text
    written_in: Text | None = None
    """Unit of the numbers in the file, if different from `unit`."""

    @model_validator(mode="before")
    @classmethod
    def _has_unit(cls, value: object) -> object:
        if isinstance(value, str | int) or (isinstance(value, dict) and value.get("unit") is None):
            raise ValueError("a signal needs a unit, such as {unit: rad, columns: q}; a number without one has unit: 1")
        return value

    @model_validator(mode="after")
    def _units_fit(self) -> "MeasuredSignalConfig":
        check_units(self.unit, self.written_in)
        return self

    @property
    def scale(self) -> float:
        """Factor from a number of the file to `unit`."""
        return factor(self.unit, self.written_in)


class TimeConfig(ColumnsConfig):
    """Stamp of every row, and the pause that ends an episode."""

    gap: Positive | None = None
    """A pause longer than this [s], or a step back, begins another episode. By default ten times the usual step."""
    written_in: Text = "s"
    """Unit of the numbers in the file; dates (2024-05-01 12:00:00.5) need none."""

    @model_validator(mode="after")
    def _is_time(self) -> "TimeConfig":
        check_units("s", self.written_in)
        if len(self.expanded()) != 1:
            raise ValueError("the time is one column")
        return self

    def seconds(self, stamps: np.ndarray) -> np.ndarray:
        """Return stamps of a file in s, shape (rows,)."""
        return stamps * factor("s", self.written_in)

    def pause(self, steps: np.ndarray) -> float:
        """Return the pause that ends an episode [s] from the steps between rows, shape (rows - 1,)."""
        forward = steps[steps > 0.0]
        return self.gap or (USUAL * float(np.median(forward)) if len(forward) else math.inf)


class MeasuredConfig(Section):
    """Description of measured data."""

    recording: Text
    description: str = ""
    episodes: tuple[str, ...] = Field(min_length=1)
    """Patterns of files or folders; each match is at least one episode."""
    separator: str = Field(",", min_length=1, max_length=1)
    """Character between cells; a space stands for any number of spaces and tabs."""
    decimal: str = Field(".", pattern="^[.,]$")
    """Character before the decimals."""
    header: bool = True
    """Whether the first line names the columns."""
    cut_to_shortest: bool = False
    """Whether the files of a folder may have different numbers of rows; only rows that all files have are used."""
    names: Text = ""
    """Column with the name of the message that a row holds; its value `speed` is then the column `message.speed`, or
    `message` if a row has only one value. Needs `interpolate`."""
    signals: dict[str, MeasuredSignalConfig] = Field(min_length=1)
    time: TimeConfig | None = None
    """Time column; without it a file is one episode."""
    episode: ColumnsConfig | None = None
    """Column with the number of the episode; another number begins another episode."""
    every: Count = 1
    """Of this many rows one is used."""
    rate: Positive | None = None
    """Rows are used at most at this rate [Hz]; needs `time`."""
    interpolate: Positive | None = None
    """For rows that hold some of the signals only, and files with stamps of their own: every signal is interpolated at
    `rate` between its samples, where these are at most this far apart [s]. Each file has the column of `time`."""
    conditions: dict[str, Text] = Field(default_factory=dict)
    """Condition of the body by pattern of an episode's file or folder; if empty, all have the same condition."""
    together: tuple[tuple[str, ...], ...] = ()
    """Groups of patterns of episodes' names. Repetitions of a motion become one episode; otherwise the held-out data
    could repeat a motion of the training data."""
    network: NetworkConfig = NetworkConfig()
    structure: StructureConfig = StructureConfig()
    training: TrainingConfig = TrainingConfig()

    @model_validator(mode="before")
    @classmethod
    def _short_forms(cls, value: object) -> object:
        if not isinstance(value, dict):
            return value
        for key in ("recording", "episodes", "signals"):
            if key not in value:
                raise ValueError(f"'{key}' is missing; a description needs recording, episodes and signals")
        for key in ("signals", "conditions"):
            if not isinstance(value.get(key, {}), dict):
                raise ValueError(f"'{key}' is a mapping, such as {EXAMPLES[key]}")
        episodes, separator = value.get("episodes"), value.get("separator")
        short = {"episodes": (episodes,)} if isinstance(episodes, str) else {}
        return {**value, **short, **({"separator": SEPARATORS[separator]} if separator in SEPARATORS else {})}

    @model_validator(mode="after")
    def _fits_together(self) -> "MeasuredConfig":
        if self.separator == self.decimal:
            raise ValueError(f"separator and decimal are both '{self.decimal}'; is the separator ';'?")
        if self.rate is not None and self.time is None:
            raise ValueError("rate needs the column of the time, such as time: {columns: t}; or write every: 10")
        if self.rate is not None and self.every != 1:
            raise ValueError("every and rate both leave rows out; write one of them")
        if self.interpolate is not None and (self.rate is None or self.time is None):
            raise ValueError("interpolate needs time and rate, such as time: {columns: t} and rate: 50")
        if self.names and self.interpolate is None:
            raise ValueError("names needs interpolate, such as interpolate: 0.5, because a row has one message only")
        if self.interpolate is not None and self.episode is not None:
            raise ValueError("episode and interpolate cannot be used together; write each episode to a file of its own")
        owners: dict[tuple[str | None, str], str] = {}
        for name, part in self.signals.items():
            for column in part.expanded():
                if (part.file, column) in owners:
                    raise ValueError(f"column '{column}' is in signal '{owners[part.file, column]}' and in '{name}'")
                owners[part.file, column] = name
        return self

    @property
    def style(self) -> TextStyle:
        """Form of the text files."""
        return TextStyle(self.separator, self.header, self.decimal, self.names)

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


class _Loader(yaml.SafeLoader):
    """YAML in which a key may be given once; of two, YAML keeps the last without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping of a node."""
        seen: list[object] = []
        for place, _ in node.value:
            key = self.construct_object(place, deep=True)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"'{key}' is given twice", place.start_mark)
            seen.append(key)
        return super().construct_mapping(node, deep)


def load_measured(path: Path) -> MeasuredConfig:
    """Read and check a description.

    Raises:
        ConfigError: The file is missing, is not YAML, or is not a description of data.
    """
    try:
        content = parse_yaml(path.read_text(encoding="utf-8"), _Loader)
    except OSError as error:
        raise ConfigError(f"The description '{path}' cannot be read: {error.strerror}.") from None
    except yaml.MarkedYAMLError as error:
        line = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"'{path}' is not YAML{line}: {error.problem}.") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"'{path}' is not YAML: {str(error).splitlines()[0]}.") from None
    if not isinstance(content, dict):
        raise ConfigError(f"'{path}' is not a description of data: it needs recording, episodes and signals.")
    try:
        return MeasuredConfig.model_validate(content)
    except ValidationError as error:
        raise ConfigError(f"'{path}': {explain(error, MeasuredConfig)}") from None


def is_description(path: Path) -> bool:
    """Whether a YAML file describes measured data rather than a robot."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False
    try:
        content = parse_yaml(text)
    except yaml.YAMLError:
        return re.search(r"^recording\s*:", text, re.MULTILINE) is not None  # its fault is to be reported
    return isinstance(content, dict) and ("recording" in content or {"episodes", "signals"} <= set(content))


def _expanded(column: str) -> Iterator[str]:
    match = RANGE.search(column)
    if match is None:
        yield column
        return
    width = len(match[1]) if match[1].startswith("0") else 0
    for number in range(int(match[1]), int(match[2]) + 1):
        yield from _expanded(f"{column[: match.start()]}{number:0{width}d}{column[match.end() :]}")
