"""What somebody else wrote, fit for a sentence, a log and a terminal."""

from typing import Any

LONGEST = 300


def plain(text: str, most: int = LONGEST) -> str:
    """A text as one line of at most so many signs, without any that act on a terminal."""
    seen = "".join(sign if sign.isprintable() else "?" for sign in text[: most + 1])
    return seen if len(seen) <= most else f"{seen[: most - 3]}..."


def shown(value: Any) -> str:
    """A value that came over the network, short; of what may be nested without end only the type."""
    if isinstance(value, str):
        return f"'{plain(value, 60)}'"
    if value is None or isinstance(value, bool | int | float):
        return f"{value}"
    return f"something of type {type(value).__name__}"
