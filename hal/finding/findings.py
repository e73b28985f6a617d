"""What somebody who looks for what is wrong has found."""

from dataclasses import dataclass
from enum import StrEnum


class Verdict(StrEnum):
    """How it stands, worst last."""

    OK = "ok"
    WARNING = "warning"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        what: As in `interface can0`.
        verdict: How it stands.
        text: What was found, and if it is not good, what to do.
    """

    what: str
    verdict: Verdict
    text: str


def ok(what: str, text: str) -> Finding:
    """All is well."""
    return Finding(what, Verdict.OK, text)


def warning(what: str, text: str) -> Finding:
    """It works, but not for certain or not as well as it could."""
    return Finding(what, Verdict.WARNING, text)


def bad(what: str, text: str) -> Finding:
    """It does not work."""
    return Finding(what, Verdict.BAD, text)
