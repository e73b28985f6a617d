"""Guess of the form of a text file: separator, decimal character, header."""

from itertools import islice
from pathlib import Path

from services.measured.text_table import TextStyle, decoded, lines_of, stamp_of

LINES = 200
"""The form is guessed from this many lines."""


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
