"""Tables in which a row has one message: a column holds its name, and the other columns its values."""

import math
from collections.abc import Sequence

import numpy as np

from gemuco.errors import DatasetError
from services.measured.table import Table, place_of

MOST_CELLS = 400_000_000
"""A table of more cells than this, when every value has a column of its own, does not fit into memory."""


def widened(raw: Table, keys: Sequence[str], names: str, stamps: frozenset[str], wanted: Sequence[str] | None) -> Table:
    """Return a table in which every value of every message has a column of its own.

    Args:
        raw: All columns of the file.
        keys: Name of the message of every row; empty where the row is broken.
        names: The column that the names are from.
        stamps: Columns of the time, which stay as they are.
        wanted: Requested columns; every one that has a number if None.

    Returns:
        The table. A value is called `message.column`, or by its message alone if a row has only one value.

    Raises:
        DatasetError: A column is missing, or they are too many.
    """
    times = [raw.names[place_of(raw.path, name, raw.names)] for name in stamps]
    values = [name for name in raw.columns if name != names and name not in times]
    texts, codes = np.unique(np.array(keys), return_inverse=True)
    messages = {key: code for code, key in enumerate(texts.tolist()) if key}
    labels = {key if len(values) == 1 else f"{key}.{value}": (key, value) for key in messages for value in values}
    known = (*times, *labels)
    chosen = known if wanted is None else tuple(known[place_of(raw.path, name, known)] for name in wanted)
    if len(chosen) * len(keys) > MOST_CELLS:
        raise DatasetError(
            f"'{raw.path}' has {len(keys)} rows and {len(messages)} messages, which is too much at once. Divide the "
            "file, or write a description with fewer signals by hand."
        )
    columns = {}
    for name, label in zip(chosen if wanted is None else wanted, chosen, strict=True):
        if label in labels:
            key, value = labels[label]
            column = np.where(codes == messages[key], raw.columns[value], math.nan)
            if wanted is None and not np.isfinite(column).any():
                continue
        else:
            column = raw.columns[label]
        columns[name] = column
    return Table(raw.path, known, columns, raw.notes)
