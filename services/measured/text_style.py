"""Guess of the form of a text file: separator, decimal character, header."""

import re
from itertools import islice, pairwise
from pathlib import Path

from services.measured.text_table import SAMPLE, TextStyle, TextTable, decoded, lines_of, stamp_of

LINES = 200
"""The form is guessed from this many lines."""

ID = {"id", "canid", "arbitration"}
"""A column whose name has one of these words may name the message of a row by a number."""
NAME = ID | {"topic", "message", "msg", "signal", "name", "channel", "frame", "key", "variable", "sensor", "tag"}
"""Texts of a column without one of these words name messages only if there are three or more: red and green do not."""
LEAST, OFTEN, FEW = 20, 0.2, 0.5
"""A name of messages needs at least this many rows, changes in this share of them, and has values for this share."""


def guess_style(path: Path) -> TextStyle:
    """Return the form with which the most cells of the first lines are numbers, in lines of the same length.

    Raises:
        DatasetError: The file is no text.
    """
    text = decoded(path)
    best, most = TextStyle(), (-1.0, 0)
    for separator in (",", ";", "\t", "|", " "):
        lines = [cells for _, cells in islice(lines_of(text, separator), LINES)]
        body = [cells for cells in lines[1:] if not cells[0].lstrip().startswith("#")]
        if not body:
            continue
        sizes = [len(cells) for cells in body]
        usual = max(set(sizes), key=sizes.count)
        for decimal in (".", ","):
            if decimal == separator:
                continue
            numbers = sum(_is_number(cell, decimal) for cells in body for cell in cells)
            score = (round(sizes.count(usual) / len(body) * numbers / sum(sizes), 3), usual)
            if score > most:
                best, most = TextStyle(separator, _is_header(lines[0], usual, decimal), decimal), score
    return best


def message_column(path: Path, style: TextStyle) -> str | None:
    """Return the column that names the message of each row; None if every row has all values.

    It has text or is called an ID, it has few values, and neighbouring rows often differ in it: a remark such as the
    name of a tool stays the same for many rows.
    """
    table = TextTable(path, style)
    lines = [cells for _, cells in islice(lines_of(decoded(path), style.separator), SAMPLE)]
    rows = [cells for cells in lines[1:] if len(cells) >= len(table.names)]
    for place, label in enumerate(table.labels):
        keys = [cells[place].strip() for cells in rows]
        changes = sum(key != after for key, after in pairwise(keys))
        words = set(re.split(r"[^a-z]+", label.lower()))
        is_text = not any(_is_number(key, style.decimal) for key in keys)
        is_name = bool(ID & words) or (is_text and (bool(NAME & words) or len(set(keys)) > 2))
        if is_name and len(keys) > LEAST and changes > OFTEN * len(keys) and 1 < len(set(keys)) < FEW * len(keys):
            return label
    return None


def _is_header(cells: list[str], usual: int, decimal: str) -> bool:
    """Whether a first line names the columns; a comment (#) does if it has a word for each."""
    if cells[0].lstrip().startswith("#"):
        return len(cells) - (cells[0].strip() == "#") == usual
    return not all(_is_number(cell, decimal) for cell in cells)


def _is_number(cell: str, decimal: str) -> bool:
    try:
        stamp_of(cell, decimal)
    except ValueError:
        return False
    return True
