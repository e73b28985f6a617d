"""Text of a DBC file, with two slips mended that programs of vendors overlook and cantools refuses."""

import re

STANDARD, EXTENDED = 0x7FF, 0x8000_0000
"""Largest identifier of 11 bits, and the bit that marks one of 29 bits."""
NO_MESSAGE = "3221225472"
"""Signals of no message stand in a message with this identifier, `VECTOR__INDEPENDENT_SIG_MSG`, which is never sent."""
_NUMBERED = re.compile(
    r'^(\s*(?:BO_|VAL_|BO_TX_BU_|SIG_VALTYPE_|SIG_GROUP_|SG_MUL_VAL_|(?:CM_|BA_\s+"[^"]*")\s+(?:BO_|SG_))\s+)(\d+)\b',
    re.MULTILINE,
)
"""A statement that names a message by its identifier."""
_DECLARED = re.compile(r"^\s*(?:BO_\s+(\d+)\s|SG_\s+(\w+)\s)", re.MULTILINE)
_NAMED_VALUES = re.compile(r'^\s*VAL_\s+(\d+)\s+(\w+)(?:\s+-?\d+\s+"[^"]*")*\s*;', re.MULTILINE)


def decoded(data: bytes) -> str:
    """Return the text of a file: DBC files are in cp1252, but many programs write UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


def mended(text: str) -> str:
    """Return a text that cantools reads.

    An identifier of more than 11 bits is marked as one of 29 bits, which it can only be. Names of values without a
    signal are left out.
    """
    text = _NUMBERED.sub(lambda match: match[1] + _marked(match[2]), text)
    signals, message = set(), ""
    for number, name in _DECLARED.findall(text):
        message = number or message
        if message != NO_MESSAGE:
            signals.add((message, name))

    def kept(match: re.Match[str]) -> str:  # or as many empty lines, for the numbers of lines in errors
        return match[0] if match.groups() in signals else "\n" * match[0].count("\n")

    return _NAMED_VALUES.sub(kept, text)


def _marked(number: str) -> str:
    return str(int(number) | EXTENDED) if STANDARD < int(number) < EXTENDED else number
