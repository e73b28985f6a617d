"""Columns of one file, by name or by number."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from gemuco.errors import DatasetError

NUMBER = r"[-+\d.,eE]*\d[-+\d.,eE]*"


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of one file.

    Attributes:
        path: The file.
        names: All columns of the file.
        columns: Requested column -> its numbers, shape (rows,), NaN where no number is.
        notes: Sentences on rows that were left out.
        texts: Column -> number of cells that hold text; only if all columns were requested.
    """

    path: Path
    names: tuple[str, ...]
    columns: Mapping[str, np.ndarray]
    notes: tuple[str, ...] = ()
    texts: Mapping[str, int] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """Number of rows of the longest column."""
        return max((len(column) for column in self.columns.values()), default=0)


def place_of(path: Path, name: str, names: Sequence[str], separator: str = "") -> int:
    """Return the index of a column given by its name or its number from 0.

    Raises:
        DatasetError: There is none, or there are several.
    """
    if names.count(name) == 1:
        return names.index(name)
    if name in names:
        twice = [str(index) for index, other in enumerate(names) if other == name]
        raise DatasetError(f"'{path}' has several columns '{name}'; give the number of one: {', '.join(twice)}.")
    if name.isdigit() and int(name) < len(names):
        return int(name)
    listed = ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")
    near = get_close_matches(name.lower(), [other.lower() for other in names], 1, 0.7)
    meant = next((f" Is '{other}' meant?" for other in names if near and other.lower() == near[0]), "")
    other = next((mark for mark in ";\t,|" if len(names) == 1 and mark != separator and mark in names[0]), None)
    if other is not None:
        meant = f" Is the separator '{shown(other)}'?"
    if separator and all(re.fullmatch(NUMBER, other) for other in names):
        meant = " The first line holds numbers; if it is no header, write header: false and give columns by number."
    elif name.isdigit():
        meant = f" Numbers of columns go from 0 to {len(names) - 1}."
    raise DatasetError(f"'{path}' has no column '{name}'. Columns: {listed}.{meant}")


def shown(separator: str) -> str:
    """Return a separator as it is written in a description."""
    return {"\t": "\\t", " ": "space"}.get(separator, separator)


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: 1 row, 2 rows."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
