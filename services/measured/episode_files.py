"""Files of a recording that has no description yet: which are episodes of their own, and which belong to one."""

from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from gemuco.errors import DatasetError
from services.measured.column_groups import Column
from services.measured.lerobot_files import data_files
from services.measured.table import Table
from services.measured.table_files import TABLES, read_table
from services.measured.text_style import guess_style, message_column
from services.measured.text_table import TextStyle

TEXTS = TABLES - {".npz", ".npy", ".parquet"}
"""Files of these kinds are text."""
TEXT = 0.1
"""A column with text in more than this share of its rows holds no signal."""
LOOSE = {".txt", ".dat"}
"""Files of these kinds in a folder are no tables if it has others that are."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Columns of all episodes of one recording.

    Attributes:
        folder: Folder of the episodes.
        patterns: Patterns of the episodes' files or folders.
        style: Form of the text files.
        episodes: File -> table, of every episode; the file is None if the episode is one.
        columns: All columns, one episode after the other.
        texts: Columns with text in place of numbers.
    """

    folder: Path
    patterns: tuple[str, ...]
    style: TextStyle
    episodes: tuple[dict[str | None, Table], ...]
    columns: tuple[Column, ...]
    texts: tuple[str, ...]

    @property
    def notes(self) -> list[str]:
        """Sentences on broken rows."""
        return [note for tables in self.episodes for table in tables.values() for note in table.notes]

    @property
    def rows(self) -> int:
        """Number of rows of all episodes."""
        return sum(min(table.rows for table in tables.values()) for tables in self.episodes)

    @property
    def messages(self) -> str | None:
        """Column that names the message of each row; None if every row has all values, or the files are no text."""
        path = next(iter(self.episodes[0].values())).path
        return message_column(path, self.style) if path.suffix.lower() in TEXTS else None

    @property
    def is_ragged(self) -> bool:
        """Whether files of one folder have different numbers of rows."""
        return any(len({table.rows for table in tables.values()}) > 1 for tables in self.episodes)

    def parts(self, column: Column) -> list[np.ndarray]:
        """Return the numbers of a column, one array per episode."""
        return [tables[column.file].columns[column.label] for tables in self.episodes]


def read_recording(paths: list[Path], names: str = "", stamps: tuple[str, ...] = ()) -> Recording:
    """Read all columns of files or folders.

    A folder of files with the same columns holds episodes; a folder of files with other columns each is an episode.

    Args:
        paths: Files or folders.
        names: Column that names the message of each row; see `MeasuredConfig.names`.
        stamps: Columns that may hold dates.

    Raises:
        DatasetError: A file cannot be read, or has other columns than the first.
    """
    places = [place for path in paths for place in _places(path)]
    style = replace(_common_style(places[0]), names=names)
    episodes = tuple(
        {file: read_table(path, style, None, stamps) for file, path in _files(place).items()} for place in places
    )
    head = {file: table.columns.keys() for file, table in episodes[0].items()}
    for place, tables in zip(places[1:], episodes[1:], strict=True):
        if {file: table.columns.keys() for file, table in tables.items()} != head:
            raise DatasetError(
                f"'{place}' has other columns or files than '{places[0]}', so one description does not fit both. "
                "Describe them separately."
            )
    columns = tuple(
        Column(file, label, np.concatenate([tables[file].columns[label] for tables in episodes]))
        for file, labels in head.items()
        for label in labels
    )
    texts = {
        name: None
        for tables in episodes
        for table in tables.values()
        for name in table.texts
        if table.texts[name] > TEXT * table.rows
    }
    folder, patterns = _patterns(places)
    return Recording(folder, patterns, style, episodes, columns, tuple(texts))


def _places(path: Path) -> list[Path]:
    """Return the episodes in a file or folder."""
    if not path.exists():
        raise DatasetError(
            f"There is no file or folder '{path}'. Give a table (.csv, .npz, .parquet) or a folder of them."
        )
    if path.is_file():
        return [path]
    if dataset := data_files(path):
        return dataset
    files = _tables(path)
    if not files:
        inner = sorted(place for place in path.iterdir() if place.is_dir() and _tables(place))
        if not inner:
            raise DatasetError(f"The folder '{path}' holds no table ({', '.join(sorted(TABLES))}).")
        return inner
    if len(files) == 1 or len({_head(file) for file in files}) > 1:
        return [path] if len(files) > 1 else files
    return files


def _tables(folder: Path) -> list[Path]:
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in TABLES and path.is_file())
    return [path for path in files if path.suffix.lower() not in LOOSE] or files


def _head(path: Path) -> tuple[str, ...]:
    """Return the names or the number of the columns of a file."""
    return read_table(path, _style(path), None).names


def _common_style(place: Path) -> TextStyle:
    """Return the form of the files of an episode; a file of one column shows no separator.

    Raises:
        DatasetError: They have several forms.
    """
    paths = list(_files(place).values())
    wide = [path for path in paths if path.suffix.lower() in TEXTS and len(_head(path)) > 1]
    styles = {_style(path) for path in wide or paths[:1]}
    if len(styles) > 1:
        raise DatasetError(
            f"The files of '{place}' differ in separator, header or decimals, so one description does not fit them "
            "all. Name the files of one recording."
        )
    return styles.pop()


def _style(path: Path) -> TextStyle:
    return guess_style(path) if path.suffix.lower() in TEXTS else TextStyle()


def _files(place: Path) -> dict[str | None, Path]:
    return {None: place} if place.is_file() else {path.name: path for path in _tables(place)}


def _patterns(places: list[Path]) -> tuple[Path, tuple[str, ...]]:
    """Return the common folder of places, and one pattern of them all if there is one, otherwise their names."""
    places = [place.resolve() for place in places]
    folder = places[0].parent
    while not all(place.is_relative_to(folder) and place != folder for place in places):
        folder = folder.parent
    names = [place.relative_to(folder) for place in places]
    if len(names) > 1 and len({len(name.parts) for name in names}) == 1:
        pattern = "/".join(_common(list(parts)) for parts in zip(*(name.parts for name in names), strict=True))
        if {path for path in folder.glob(pattern) if path.is_dir() == places[0].is_dir()} == set(places):
            return folder, (pattern,)
    return folder, tuple(name.as_posix().replace("[", "[[]") for name in names)


def _common(names: list[str]) -> str:
    """Return a pattern of names: what they have in common at the start and at the end."""
    if len(set(names)) == 1:
        return names[0].replace("[", "[[]")
    short = min(names, key=len)
    head = next((i for i in range(len(short)) if len({name[i] for name in names}) > 1), len(short))
    rest = [name[head:] for name in names]
    tail = next(
        (i for i in range(min(map(len, rest))) if len({name[-1 - i] for name in rest}) > 1), min(map(len, rest))
    )
    pattern = f"{short[:head]}*{short[len(short) - tail :] if tail else ''}".replace("[", "[[]")
    assert all(fnmatch(name, pattern) for name in names)
    return pattern
