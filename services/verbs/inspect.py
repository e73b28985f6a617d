"""`gemuco inspect`: find sensors that lied in measured tables, and write what they should have read."""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import typer
from rich.table import Table

from gemuco import checkpoint, writing
from gemuco.errors import DatasetError
from gemuco.signals import Layout
from gemuco.trust.inspection import Inspection, Inspector, Lie
from hal.errors import ConfigError
from services import show
from services.measured import description
from services.measured.description import MeasuredConfig
from services.measured.reading import Timed, read_timed
from services.measured.table import counted
from services.measured.table_files import is_table
from services.model import artifacts
from services.recording.dataset import is_recording

ALIKE = 1.05
"""The rates of tables that are inspected together differ by at most this factor."""


def run_inspection(file: Path, data: Sequence[Path], model: Path | None, rate: float | None, out: Path | None) -> None:
    """Print the lies in measured tables; arguments are those of the verb.

    Raises:
        SchemaError: Data, model or description do not fit.
    """
    if not file.is_file():
        raise ConfigError(f"There is no file '{file}'. Name the description that `gemuco train` used.")
    if not description.is_description(file):
        what = "holds data" if is_table(file) else "is no description of measured tables"
        raise ConfigError(
            f"'{file}' {what}. Name the description that `gemuco train` used, and the tables with --data."
        )
    config = description.load_measured(file)
    schema = checkpoint.load(model or artifacts.model_folder(config.recording))
    parts = [_read(config, place) for place in data]
    names = [name for part in parts for name in part.names]
    episodes = [episode for part in parts for episode in part.dataset.episodes]
    rate = rate or _rate(parts)
    inspector, lies, rows = Inspector(schema, rate), _Lies(names), 0
    with show.progress("inspecting") as progress:
        for number, (name, episode) in enumerate(zip(names, episodes, strict=True)):
            progress(number / len(names), name)
            known = {signal: episode.values[signal] for signal in schema.layout.names if signal in episode.values}
            own = schema.under(episode.condition) if episode.condition in schema.biases else schema
            result = inspector.inspect(known, own)
            length = len(result.hidden[schema.layout.names[0]])
            lies.add(number, result.lies, length / rate)
            rows += length
            if out is not None:
                _write(out / f"{number:03d}_{re.sub(r'[^A-Za-z0-9_-]+', '_', name)}.csv", result, schema.layout, rate)
    if lies.known:
        show.console().print(lies.table(schema.layout))
    count = sum(known.lie.is_hidden for known in lies.known)
    where = f"{counted(len(names), 'episode')}, {rows / rate / 60.0:.1f} min at {rate:g} rows per second"
    typer.echo(f"{counted(count, 'lie')} in {where}.")
    if out is not None:
        typer.echo(f"Written to {out}; the last column names what is an estimate.")


def _read(config: MeasuredConfig, place: Path) -> Timed:
    """Return the episodes of one table, or of all tables in a folder if none has a name of the description."""
    if not place.exists():
        raise DatasetError(f"There is no file or folder '{place}'. Name the tables to inspect with --data.")
    if is_recording(place):
        raise DatasetError(f"'{place}' is a recording of a robot; `gemuco export` writes it as a table.")
    patterns = (place.name,) if place.is_file() else config.episodes
    folder = place.parent if place.is_file() else place
    if not any(True for pattern in patterns for _ in folder.glob(pattern)):
        patterns = ("*",)
    return read_timed(config.model_copy(update={"together": (), "episodes": patterns}), folder, typer.echo)


def _rate(parts: Sequence[Timed]) -> float:
    """Return the rate of all tables [Hz]."""
    rates = [part.rate for part in parts if part.rate is not None]
    if not rates:
        raise DatasetError("The tables have no time, so their rate is not known; give the rows per second with --rate.")
    if max(rates) > ALIKE * min(rates):
        raise DatasetError(
            f"The tables have {min(rates):g} to {max(rates):g} rows per second; inspect those of one rate at a time."
        )
    return rates[0]


@dataclass(slots=True)
class _Known:
    """A lie, and the numbers of the episodes in which it begins and ends."""

    lie: Lie
    first: int
    last: int


class _Lies:
    """The lies in successive episodes; one that goes on in the next episode of its table is one lie."""

    def __init__(self, names: Sequence[str]) -> None:
        """Take the table of every episode."""
        self._names, self._length = names, 0.0
        self.known: list[_Known] = []

    def add(self, number: int, lies: Sequence[Lie], length: float) -> None:
        """Add the lies in an episode of a length [s]."""
        before = [known for known in self.known if known.last == number - 1 and known.lie.end >= self._length]
        for lie in lies:
            same = next((known for known in before if self._goes_on(known, lie, number)), None)
            if same is None:
                self.known.append(_Known(lie, number, number))
            else:
                same.lie, same.last = replace(same.lie, end=lie.end), number
        self._length = length

    def table(self, layout: Layout) -> Table:
        """Return a row for each lie."""
        table = Table("episode")
        for head in ("from [s]", "to [s]"):
            table.add_column(head, justify="right")
        table.add_column("wrong")
        table.add_column("kind")
        table.add_column("error", justify="right")
        table.add_column("used, because")
        for known in self.known:
            table.add_row(*_line(self._label(known), known.lie, layout))
        return table

    def _goes_on(self, known: _Known, lie: Lie, number: int) -> bool:
        is_same = set(known.lie.elements) == set(lie.elements) and known.lie.is_hidden == lie.is_hidden
        return is_same and lie.start == 0.0 and self._names[number] == self._names[known.last]

    def _label(self, known: _Known) -> str:
        name = self._names[known.first]
        if self._names.count(name) == 1:
            return name
        last = "" if known.last == known.first else f" to {known.last}"
        return f"{name}, {known.first}{last}"


def _line(name: str, lie: Lie, layout: Layout) -> tuple[str, ...]:
    """Return a row of the table; of a table with several episodes `name` has their numbers."""
    what = {"environment": "another tool or load", "body": "the body, no sensor explains it"}.get(lie.cause)
    joined = {"either": " or ", "all": " and ", "part": " and "}.get(lie.cause, ", ").join(lie.elements)
    unit = layout.signal(lie.elements[0].partition(".")[0]).unit if lie.elements else ""
    size = f"{lie.size:.3g} {'' if unit == '1' else unit}".rstrip() if np.isfinite(lie.size) else ""
    return name, f"{lie.start:.1f}", f"{lie.end:.1f}", what or joined, lie.kind, size, lie.reason


def _write(path: Path, result: Inspection, layout: Layout, rate: float) -> None:
    """Write the samples with estimates in place of what was hidden."""
    values, hidden = layout.join(result.values), layout.join(result.hidden) > 0.0
    names = [layout.element(index) for index in range(layout.size)]
    units = [layout.signal(name.partition(".")[0]).unit for name in names]
    path.parent.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["time [s]", *(f"{name} [{unit}]" for name, unit in zip(names, units, strict=True)), "estimated"])
    for number, (row, wrong) in enumerate(zip(values, hidden, strict=True)):
        estimated = " ".join(name for name, is_wrong in zip(names, wrong, strict=True) if is_wrong)
        cells = (f"{value:.9g}" if np.isfinite(value) else "" for value in row)
        table.writerow([f"{number / rate:.6g}", *cells, estimated])
    with writing.writing("The inspected episode", path):
        writing.replace(path, text.getvalue().encode())
