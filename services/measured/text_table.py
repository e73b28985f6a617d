"""Tables of numbers from text files.

Lines that were not written completely are left out with a note; a file in which more lines are broken than `BROKEN` is
refused.
"""

import codecs
import csv
import io
import math
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

import numpy as np

from gemuco.errors import DatasetError
from services.measured.long_table import widened
from services.measured.table import Table, counted, place_of, shown

SAMPLE = 1000
"""Header and number of columns are judged by this many lines."""
BROKEN = 0.01
"""A file may have this share of broken rows, and always one; a last line that was cut off does not count."""

MISSING = {"", "nan", "na", "n/a", "#n/a", "none", "null", "-", "--", "---", "?", "-nan", "nan(ind)", "-nan(ind)"}
"""A cell with one of these texts, in lower case, was not measured."""
TRUTHS = {"true": 1.0, "false": 0.0}
"""These texts, in lower case, are numbers, as of a contact."""


@dataclass(frozen=True, slots=True)
class TextStyle:
    """Form of a text file.

    Attributes:
        separator: Character between cells; a space stands for any number of spaces and tabs.
        header: Whether the first line names the columns.
        decimal: Character before the decimals.
        names: Column with the name of the message of each row; empty if every row has all values.
    """

    separator: str = ","
    header: bool = True
    decimal: str = "."
    names: str = ""


class TextTable:
    """Lines of a text file, and the names of their columns."""

    def __init__(self, path: Path, style: TextStyle) -> None:
        self.path, self.style = path, style
        self._text = decoded(path)
        lines = list(islice(lines_of(self._text, style.separator), SAMPLE))
        head = self._head(lines)
        if not lines:
            raise DatasetError(f"'{path}' is empty: it holds no row of data.")
        self._start, self.count, self._last = lines[0][0], 0, 0
        size = Counter(len(cells) for _, cells in lines).most_common(1)[0][0]
        names = tuple(name.strip().strip("\"'") for name in head) if style.header else tuple(map(str, range(size)))
        self.names = names if any(names[size:]) else names[:size]
        if (len(self.names) > 1 and size == 1) or len(self.names) < size:
            self._refuse_header(lines, size)

    def _head(self, lines: list[tuple[int, list[str]]]) -> list[str]:
        """Take the lines before the data from the first lines, and return the cells of the header."""
        comment: list[str] | None = None
        while lines and _is_comment(lines[0][1]):
            comment = lines.pop(0)[1]
        if not lines or not self.style.header:
            return []
        if comment is None or self._is_numeric(comment) or not self._is_numeric(lines[0][1]):
            return lines.pop(0)[1]
        head = [comment[0].lstrip().lstrip("#"), *comment[1:]]  # the header is a comment, as numpy.savetxt writes it
        return [cell for cell in head if cell.strip()] if self.style.separator == " " else head

    def _refuse_header(self, lines: list[tuple[int, list[str]]], size: int) -> None:
        """Refuse a first line that does not fit the rows, unless these have empty cells at the end."""
        usual = Counter(len(_trimmed(cells)) for _, cells in lines).most_common(1)[0][0]
        if usual > len(self.names) or size == 1:
            raise DatasetError(
                f"'{self.path}': the first line names {counted(len(self.names), 'column')}, but the rows have {size}. "
                "Is it the header? Begin the lines above the header with #; without a header write header: false."
            )

    def _lines(self) -> Iterator[tuple[int, list[str]]]:
        """Yield number and cells of the lines of data, and count them."""
        self.count = 0
        for number, cells in lines_of(self._text, self.style.separator):
            if number >= self._start and not _is_comment(cells):
                self.count, self._last = self.count + 1, number
                yield number, cells

    @property
    def labels(self) -> tuple[str, ...]:
        """Names by which all columns differ: the number of a column whose name is missing or repeated."""
        counts = Counter(self.names)
        return tuple(name if name and counts[name] == 1 else str(index) for index, name in enumerate(self.names))

    def _is_numeric(self, cells: list[str]) -> bool:
        try:
            return any(math.isfinite(number_of(cell, self.style.decimal)) for cell in cells)
        except ValueError:
            return False

    def table(self, wanted: Sequence[str] | None, stamps: frozenset[str]) -> Table:
        """Return columns as numbers; a broken row is NaN, so that rows of several files stay side by side."""
        if not self.style.names:
            return self._read(wanted, stamps)
        place = self._place(self.style.names)
        keys = [cells[place].strip() if place < len(cells) else "" for _, cells in self._lines()]
        return widened(self._read(None, stamps), keys, self.labels[place], stamps, wanted)

    def _read(self, wanted: Sequence[str] | None, stamps: frozenset[str]) -> Table:
        chosen = self.labels if wanted is None else tuple(wanted)
        places = range(len(self.names)) if wanted is None else [self._place(name) for name in chosen]
        readers = [stamp_of if name in stamps or wanted is None else number_of for name in chosen]
        numbers, texts = array("d"), dict.fromkeys(chosen, 0)
        faults: list[tuple[int, str]] = []
        for line, cells in self._lines():
            try:
                row = self._plain(cells, places) or self._row(
                    cells, chosen, places, readers, texts if wanted is None else None
                )
            except ValueError as fault:
                faults.append((line, str(fault)))
                row = [math.nan] * len(chosen)
            numbers.extend(row)
        values = np.frombuffer(numbers, float).reshape(self.count, len(chosen))
        notes = self._judge(faults)
        columns = {name: values[:, index].copy() for index, name in enumerate(chosen)}
        return Table(self.path, self.names, columns, notes, texts if wanted is None else {})

    def _plain(self, cells: list[str], places: Sequence[int]) -> list[float] | None:
        """Return the numbers of a line, fast; None if it needs a closer look."""
        if self.style.decimal != "." or len(cells) != len(self.names):
            return None
        try:
            return [float(cells[place]) for place in places]
        except ValueError:
            return None

    def _row(
        self,
        cells: list[str],
        chosen: Sequence[str],
        places: Sequence[int],
        readers: Sequence[Callable[[str, str], float]],
        texts: dict[str, int] | None,
    ) -> list[float]:
        """Return the numbers of a line; a ValueError describes a broken line."""
        size = len(self.names)
        if len(cells) != size and (len(cells) < size or any(cell.strip() for cell in cells[size:])):
            first = "the header" if self.style.header else "the first"
            raise ValueError(f"has {counted(len(cells), 'column')}; {first} has {size}")
        row = []
        for name, place, reader in zip(chosen, places, readers, strict=True):
            try:
                row.append(reader(cells[place], self.style.decimal))
            except ValueError:
                if texts is None:
                    raise ValueError(f"column '{name}': '{cells[place][:30]}' is not a number") from None
                texts[name] += 1
                row.append(math.nan)
        return row

    def _judge(self, faults: list[tuple[int, str]]) -> tuple[str, ...]:
        """Return notes on broken lines.

        Raises:
            DatasetError: They are too many.
        """
        notes: list[str] = []
        middle = list(faults)
        is_cut = bool(faults) and faults[-1][0] == self._last and self.count > 1
        if is_cut:
            line, fault = middle.pop()
            notes.append(f"'{self.path}': the last line was cut off and is left out (line {line}: {fault}).")
        if len(middle) > max(1, BROKEN * self.count) or len(middle) == self.count - is_cut:
            raise DatasetError(self._refusal(middle))
        if middle:
            line, fault = middle[0]
            notes.append(
                f"'{self.path}': {len(middle)} of {self.count} rows {'is' if len(middle) == 1 else 'are'} broken "
                f"and left out (first in line {line}: {fault})."
            )
        return tuple(notes)

    def _refusal(self, faults: list[tuple[int, str]]) -> str:
        line, fault = faults[0]
        count = f" {len(faults)} of {self.count} rows are broken; at most {BROKEN:.0%} may be."
        if fault.startswith("has "):
            return (
                f"'{self.path}' line {line} {fault}. Is the separator '{shown(self.style.separator)}', and was the "
                f"file written to its end?{count}"
            )
        hint = "An empty cell means that no value was measured."
        cell = fault.partition(": '")[2].partition("'")[0]
        if self.style.decimal == "." and cell.count(",") == 1 and cell.replace(",", "").lstrip("-").isdigit():
            hint = "If the comma is before the decimals, write decimal: ','."
        return f"'{self.path}' line {line}, {fault}. {hint}{count}"

    def _place(self, name: str) -> int:
        return place_of(self.path, name, self.names, self.style.separator)


def decoded(path: Path) -> str:
    """Return the text of a file in UTF-8, UTF-16 with a mark, or a one-byte code.

    Raises:
        DatasetError: It is no text.
    """
    raw = path.read_bytes()
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    else:
        raw, encoding = raw.rstrip(b"\0"), "utf-8-sig"
        if b"\0" in raw[:4096]:
            raise DatasetError(f"'{path}' is not a text file of separated values, nor .npz or .parquet by its name.")
    try:
        return raw.decode(encoding)
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def lines_of(text: str, separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells of every line that is not empty and no comment (#)."""
    if separator == " ":
        for number, line in enumerate(text.splitlines(), start=1):
            if line.strip():
                yield number, line.split()
        return
    for number, line in enumerate(io.StringIO(text, newline=None), start=1):
        # line by line, so that a quotation mark that is not closed spoils one line only
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
        if len(cells) > 1 or (cells and cells[0].strip()):
            yield number, cells


def _is_comment(cells: list[str]) -> bool:
    return cells[0].lstrip().startswith("#")


def _trimmed(cells: list[str]) -> list[str]:
    """Return cells without empty ones at the end."""
    last = next((index for index in range(len(cells), 0, -1) if cells[index - 1].strip()), 0)
    return cells[:last]


def number_of(cell: str, decimal: str) -> float:
    """Return the number in a cell; NaN if it was not measured.

    Raises:
        ValueError: It holds anything else.
    """
    try:
        return float(cell if decimal == "." else cell.replace(decimal, "."))
    except ValueError:
        text = cell.strip().lower()
        if text in MISSING:
            return math.nan
        if text in TRUTHS:
            return TRUTHS[text]
        raise


def stamp_of(cell: str, decimal: str) -> float:
    """Return the number in a cell, or the seconds since 1970 of a date.

    Raises:
        ValueError: It holds anything else.
    """
    try:
        return number_of(cell, decimal)
    except ValueError:
        date = datetime.fromisoformat(cell.strip())
        return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
