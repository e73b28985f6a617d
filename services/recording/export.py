"""Export of recordings as tables: one table per key, one row per message, one column per element with its unit.

Messages are written while they are read, so a recording may be larger than the memory.
"""

import csv
import json
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np
from typing_extensions import override

from gemuco.writing import PART
from services.errors import RecordingError
from services.recording.reading import Paths, Recorded, facts_of, one_robot, read
from services.recording.schema import UNITS, Form
from services.wire import keys
from services.wire.records import Array, Message, Numbers, Truths

ROWS = 4096
"""Rows are written in groups of this size."""
FIRST = ("received [ns]", "stamp [ns]", "seq", "boot")
HEADER = ("v", "stamp_ns", "seq", "boot")
PLAIN = "values"
"""Columns of this field have no prefix."""


class Table(Protocol):
    """File that takes rows of the same columns."""

    path: Path
    part: Path
    """The file while it is being written; only a whole table gets the name `path`."""

    def write(self, rows: list[list[Any]]) -> None:
        """Add rows."""

    def close(self) -> None:
        """Finish the file."""


class CsvTable(Table):
    """Comma-separated text with the names of the columns in the first line; unmeasured values are empty."""

    def __init__(self, path: Path, columns: list[str], first: list[Any]) -> None:
        self.path, self.part = _new(path.with_name(path.name + ".csv"))
        self._file = self.part.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file)
        self._writer.writerow(columns)

    @override
    def write(self, rows: list[list[Any]]) -> None:
        self._writer.writerows(rows)

    @override
    def close(self) -> None:
        self._file.close()


class ParquetTable(Table):
    """Apache Parquet file; unmeasured values are null."""

    def __init__(self, arrow: ModuleType, path: Path, columns: list[str], first: list[Any]) -> None:
        import pyarrow.parquet

        self._arrow = arrow
        self.path, self.part = _new(path.with_name(path.name + ".parquet"))
        kinds = {bool: arrow.bool_(), int: arrow.int64(), float: arrow.float64(), str: arrow.string()}
        pairs = zip(columns, first, strict=True)
        self._schema = arrow.schema([(name, kinds[float if value is None else type(value)]) for name, value in pairs])
        self._writer = pyarrow.parquet.ParquetWriter(self.part, self._schema, compression="zstd")

    @override
    def write(self, rows: list[list[Any]]) -> None:
        arrays = [
            self._arrow.array(column, field.type)
            for column, field in zip(zip(*rows, strict=True), self._schema, strict=True)
        ]
        self._writer.write_table(self._arrow.Table.from_arrays(arrays, schema=self._schema))

    @override
    def close(self) -> None:
        self._writer.close()


def _new(path: Path) -> tuple[Path, Path]:
    """Return the path of a new table, and its path while it is being written."""
    if path.exists():
        raise FileExistsError
    return path, path.with_name(path.name + PART)


def run_export(paths: Paths, out: Path, form: str) -> None:
    """Write recordings as tables and print their names.

    Args:
        paths: Recordings of one robot, in any order.
        out: Folder for the tables; existing tables are never replaced.
        form: `csv` or `parquet`.

    Raises:
        RecordingError: The recordings cannot be read, or the tables cannot be written.
    """
    for path, rows in export(paths, out, form).items():
        print(f"{rows} rows in {path}")


def export(paths: Paths, out: Path, form: str) -> dict[Path, int]:
    """Write recordings as tables, like `run_export`.

    Returns:
        Table -> number of its rows.
    """
    files = facts_of(paths)
    one_robot(files)
    make = _maker(form)
    tables: dict[tuple[str, str], _OpenTable] = {}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for recorded in read([file.path for file in files]):
            signals = [recorded.form.schema["x-signals"], getattr(recorded.message, "signal", "")]
            identity = (recorded.key, json.dumps(signals))
            if identity not in tables:
                number = 1 + sum(key == recorded.key for key, _ in tables)
                tables[identity] = _OpenTable(recorded, out / _name(recorded.key, number), make)
            tables[identity].add(recorded)
        for table in tables.values():
            table.close()
    except FileExistsError:
        raise RecordingError(
            f"There are tables in '{out}' already, and they are not replaced. Name another folder."
        ) from None
    except OSError as error:
        raise RecordingError(f"The tables in '{out}' cannot be written: {error.strerror or error}.") from None
    finally:
        for table in tables.values():
            table.part.unlink(missing_ok=True)
    if not tables:
        raise RecordingError("There are no messages in these recordings.")
    return {table.path: table.rows for table in tables.values()}


def _maker(form: str) -> Callable[[Path, list[str], list[Any]], Table]:
    if form == "csv":
        return CsvTable
    if form != "parquet":
        raise RecordingError(f"'{form}' is not a format of tables. Known formats: csv, parquet, foxglove, lerobot.")
    try:
        import pyarrow
    except ImportError:
        raise RecordingError(
            "Parquet needs pyarrow, which is not installed: pip install 'gemuco[parquet]'. Or export csv."
        ) from None
    return lambda path, columns, first: ParquetTable(pyarrow, path, columns, first)


def _name(key: str, number: int) -> str:
    """Return `hal.sample`; then `hal.sample-2` (new robot description) or `model.target-2` (other signal)."""
    _, service, rest = keys.parse(key)
    return f"{service}.{rest.replace('/', '.')}" + (f"-{number}" if number > 1 else "")


class _OpenTable:
    """Table with rows that wait to be written."""

    def __init__(self, first: Recorded, path: Path, make: Callable[[Path, list[str], list[Any]], Table]) -> None:
        self.rows = 0
        self._columns = [name for name, _ in _cells(first)]
        self._waiting: list[list[Any]] = []
        self._table = make(path, self._columns, [value for _, value in _cells(first, typed=True)])
        self.path, self.part = self._table.path, self._table.part

    def add(self, recorded: Recorded) -> None:
        self._waiting.append([value for _, value in _cells(recorded)])
        if len(self._waiting) >= ROWS:
            self._write()

    def close(self) -> None:
        if self._waiting:
            self._write()
        self._table.close()
        with self.part.open("rb") as file:
            os.fsync(file.fileno())
        self.part.rename(self.path)

    def _write(self) -> None:
        self._table.write(self._waiting)
        self.rows += len(self._waiting)
        self._waiting = []


def _cells(recorded: Recorded, typed: bool = False) -> Iterator[tuple[str, Any]]:
    """Yield name and value of every column; the order depends only on the form.

    Args:
        recorded: A recorded message.
        typed: Whether a missing value is replaced by a value of the column's type.
    """
    message, form = recorded.message, recorded.form
    yield from zip(FIRST, (recorded.received_ns, message.stamp_ns, message.seq, message.boot), strict=True)
    for name, hint in form.hints.items():
        if name not in HEADER:
            yield from _columns(name, hint, message, form, typed)


def _columns(name: str, hint: Any, message: Message, form: Form, typed: bool) -> Iterator[tuple[str, Any]]:
    value = getattr(message, name)
    signals = form.catalogue.signals
    if hint == Array and not form.by_signal:
        yield name, json.dumps(value.tolist())
    elif hint in (Array, Numbers, Truths):
        only = getattr(message, "signal", "")
        by_signal = {only: value} if hint == Array else value
        for signal, listed in signals.items():
            if only and signal != only:
                continue
            is_truth = hint is Truths
            unit = "" if is_truth else UNITS.get(name, listed.unit)
            prefix = "" if name == PLAIN else f"{name}."
            suffix = f" [{unit}]" if unit else ""
            numbers = by_signal.get(signal)
            for index, element in enumerate(listed.elements):
                yield f"{prefix}{signal}.{element}{suffix}", _cell(is_truth, numbers, index, typed)
    elif hint in (dict[str, float], dict[str, str]):
        empty: Any = "" if hint == dict[str, str] else math.nan
        for signal in signals:
            yield f"{name}.{signal}", _number(value.get(signal, empty))
    elif hint is float:
        yield f"{name} [{UNITS[name]}]" if name in UNITS else name, _number(value)
    else:
        yield name, value if isinstance(value, bool | int | str) else json.dumps(value)


def _cell(is_truth: bool, numbers: np.ndarray | None, index: int, typed: bool) -> bool | float | None:
    if is_truth:
        return bool(numbers[index]) if numbers is not None else (False if typed else None)
    return None if numbers is None else _number(float(numbers[index]))


def _number(value: Any) -> Any:
    """Return the value, or None for a number that is not finite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
