"""Text of other processes, made safe for messages, logs and terminals."""

from typing import Any

LONGEST = 300


def plain(text: str, most: int = LONGEST) -> str:
    """Return a text as one line of at most `most` characters, without control characters."""
    printable = "".join(sign if sign.isprintable() else "?" for sign in text[: most + 1])
    return printable if len(printable) <= most else f"{printable[: most - 3]}..."


def shown(value: Any) -> str:
    """Format a received value briefly; of containers and other objects only the type."""
    if isinstance(value, str):
        return f"'{plain(value, 60)}'"
    if value is None or isinstance(value, bool | int | float):
        return f"{value}"
    return f"something of type {type(value).__name__}"
