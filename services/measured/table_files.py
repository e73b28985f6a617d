"""Tables of numbers from files: text with separators, NumPy archives, Parquet."""

import csv
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from gemuco.errors import DatasetError
from services.measured.lerobot_files import without_estimates
from services.measured.table import Table, place_of
from services.measured.text_table import TextStyle, TextTable

DECODE = (
    "It holds frames of a bus: decode them with the DBC file of the bus (with asammdf, for example), and save the "
    "signals as CSV, with one column of times"
)
ELSEWHERE = {
    ".xlsx": "Save the sheet as CSV",
    ".xls": "Save the sheet as CSV",
    ".mat": "Save its arrays as .npz (scipy.io.loadmat, numpy.savez) or as CSV (writetable)",
    ".h5": "Save its arrays as .npz (numpy.savez)",
    ".hdf5": "Save its arrays as .npz (numpy.savez)",
    ".pkl": "Save its arrays as .npz (numpy.savez)",
    ".json": "Save it as CSV",
    ".bag": "Export its topics as CSV",
    ".db3": "Export its topics as CSV",
    ".zip": "Unpack it first",
    ".gz": "Unpack it first",
    ".blf": DECODE,
    ".asc": DECODE,
    ".trc": DECODE,
    ".mf4": DECODE,
    ".mcap": "Train from a recording of gemuco with `gemuco train ROBOT --data FILE`, or write tables with `gemuco "
    "export FILE`",
}
"""Files of these kinds are not read; this is what to do instead."""
TABLES = {".csv", ".tsv", ".txt", ".dat", ".npz", ".npy", ".parquet"}
"""Files of these kinds hold tables."""


def is_table(path: Path) -> bool:
    """Whether a file holds a table or could be converted to one, judged by its name."""
    return path.suffix.lower() in TABLES | set(ELSEWHERE)


def read_table(path: Path, style: TextStyle, wanted: Sequence[str] | None, stamps: Iterable[str] = ()) -> Table:
    """Read columns of a file.

    Args:
        path: Text, .npz, .npy or .parquet. The column k of a matrix `a` in an archive is `a_k`.
        style: Form of a text file.
        wanted: Columns by name, or by number from 0; None reads all and takes text as a missing number.
        stamps: Columns that may hold dates (ISO 8601), which become seconds since 1970.

    Raises:
        DatasetError: The file cannot be read, lacks a column, or has too many broken rows.
    """
    kind = path.suffix.lower()
    if kind in ELSEWHERE:
        raise DatasetError(f"'{path}' cannot be read as a table. {ELSEWHERE[kind]}.")
    if style.names and kind in (".npz", ".npy", ".parquet"):
        raise DatasetError(f"'{path}': names is for text files; save the table as CSV.")
    try:
        if kind in (".npz", ".npy"):
            return _chosen(path, _archive(path), wanted)
        if kind == ".parquet":
            return _chosen(path, _parquet(path), wanted)
        return TextTable(path, style).table(wanted, frozenset(stamps))
    except csv.Error as error:
        raise DatasetError(f"'{path}' is not a text file of separated values ({error}).") from None
    except IsADirectoryError:
        raise DatasetError(f"'{path}' is a folder; name the file in it of every signal with `file:`.") from None
    except NotADirectoryError:
        raise DatasetError(
            f"'{path.parent}' is a file, but `file: {path.name}` is read from a folder; match folders in `episodes`, "
            "or leave `file` out."
        ) from None
    except OSError as error:
        raise DatasetError(f"'{path}' cannot be read: {error.strerror or error}.") from None


def _chosen(path: Path, columns: Mapping[str, np.ndarray], wanted: Sequence[str] | None) -> Table:
    names = tuple(columns)
    if not names:
        raise DatasetError(f"'{path}' holds no column of numbers.")
    if wanted is None:
        usual = Counter(map(len, columns.values())).most_common(1)[0][0]
        others = [name for name in names if len(columns[name]) != usual]
        notes = (
            [f"'{path}': {', '.join(others)} left out, because the other columns have {usual} rows."] if others else []
        )
        return Table(path, names, {name: columns[name] for name in names if name not in others}, tuple(notes))
    return Table(path, names, {name: columns[names[place_of(path, name, names)]] for name in wanted})


def _archive(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of all arrays of numbers with one or two dimensions."""
    columns: dict[str, np.ndarray] = {}
    try:
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return _split("", content)
        with content:
            if "head" in content.files and "episode_0" in content.files:
                raise DatasetError(
                    f"'{path}' was written by `gemuco collect`; train with `gemuco train ROBOT --data {path}`."
                )
            for name in content.files:
                values = content[name]
                if values.dtype.kind in "biuf" and values.ndim in (1, 2):
                    columns |= _split(name, values)
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DatasetError(f"'{path}' is not a readable NumPy file ({error}).") from None
    return columns


def _split(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of an array, shape (rows,), (1, rows) as MATLAB writes it, or (rows, n)."""
    if values.ndim == 2 and len(values) == 1:
        values = values[0]
    if values.ndim == 1:
        return {name or "0": values.astype(float)}
    return {f"{name}_{k}" if name else str(k): values[:, k].astype(float) for k in range(values.shape[1])}


def _parquet(path: Path) -> dict[str, np.ndarray]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise DatasetError(
            "Parquet needs pyarrow, which is not installed: pip install 'gemuco[parquet]'. Or save the table as CSV."
        ) from None
    try:
        content = pyarrow.parquet.read_table(path)
    except pyarrow.ArrowException as error:
        raise DatasetError(f"'{path}' is not a readable Parquet file ({str(error).splitlines()[0]}).") from None
    columns: dict[str, np.ndarray] = {}
    for name, column in zip(content.column_names, content.columns, strict=True):
        if pyarrow.types.is_timestamp(column.type):
            micros = column.cast(pyarrow.timestamp("us"), safe=False).cast(pyarrow.int64())
            columns[name] = np.array(micros.to_pylist(), float) * 1e-6
        elif pyarrow.types.is_integer(column.type) or pyarrow.types.is_floating(column.type):
            columns[name] = np.array(column.cast(pyarrow.float64()).to_pylist(), float)
        elif pyarrow.types.is_fixed_size_list(column.type) or pyarrow.types.is_list(column.type):
            rows = column.to_pylist()
            if rows and len({len(row) if row is not None else -1 for row in rows}) == 1:
                columns |= _split(name, np.array(rows, float))
    return without_estimates(path, columns)
