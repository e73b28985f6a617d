"""What a recording lacks: counted per key, told in the file as facts and, with the time, as lines of its log."""

import json
from collections import Counter
from collections.abc import Iterator
from typing import Any

INFO, WARNING, ERROR = 2, 3, 4
"""Levels of foxglove.Log."""
LOG = "foxglove.Log"
OTHERS = "other keys"
FURTHEST = 1_000_000_000
"""No sender is so many messages ahead, not after two months at 200 Hz: who says so did not count."""
SENDERS = 8
"""Senders of one key that are counted apart; of more, the first is forgotten."""
MOST_KEYS = 1000
"""Keys of which what was dropped is counted apart: anybody may make up more."""
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
LOG_SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": LOG,
    "description": "What happened while recording; Foxglove shows it in its Log panel.",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "level": {"type": "integer", "description": "2 info, 3 warning, 4 error"},
        "message": {"type": "string"},
        "name": {"type": "string", "description": "The service that it is about."},
        "file": {"type": "string"},
        "line": {"type": "integer"},
        "kind": {
            "type": "string",
            "description": "alive, gone, holder, robot, file, clock, dropped, missed, malformed",
        },
        "key": {"type": "string"},
        "count": {"type": "integer", "description": "How many messages."},
    },
    "required": ["timestamp", "level", "message", "name", "kind"],
}
_SENTENCES = {
    "dropped": "{count} messages came, and could not be written.",
    "missed": "{count} messages never came: their numbers are missing.",
    "malformed": "{count} messages were not what this key carries; their bytes are kept.",
}


class Losses:
    """Counts of what a recording lacks, per key, over all its files."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        """Came, and could not be written: too many at once, or no space."""
        self.missed: Counter[str] = Counter()
        """Never came; told by gaps in the senders' counting."""
        self.malformed: Counter[str] = Counter()
        """Were not what their key carries; their bytes are in the recording."""
        self._told = {kind: Counter[str]() for kind in _SENTENCES}
        self._last: dict[str, dict[int, int]] = {}

    def arrived(self, key: str, boot: int, seq: int) -> None:
        """Note a sender's number, and what is missing before it."""
        senders = self._last.setdefault(key, {})
        before = senders.get(boot)
        if before is None:
            if len(senders) >= SENDERS:
                del senders[next(iter(senders))]
        elif seq <= before or seq - before > FURTHEST:
            return
        elif seq > before + 1:
            self.missed[key] += seq - before - 1
        senders[boot] = seq

    def drop(self, key: str, count: int = 1) -> None:
        """Count what came on a key and could not be written; the gap that it leaves is not counted as missed too."""
        self.dropped[key if key in self.dropped or len(self.dropped) < MOST_KEYS else OTHERS] += count
        self._last.pop(key, None)

    def totals(self) -> dict[str, int]:
        """`dropped`, `missed` and `malformed`, of all keys."""
        return {kind: getattr(self, kind).total() for kind in _SENTENCES}

    def facts(self) -> dict[str, str]:
        """The same as text, and each by key as JSON."""
        totals = {kind: str(count) for kind, count in self.totals().items()}
        return totals | {f"{kind}_by_key": json.dumps(dict(getattr(self, kind))) for kind in _SENTENCES}

    def news(self) -> Iterator[tuple[str, str, int]]:
        """Kind, key and number of what was lost since the last call."""
        for kind, told in self._told.items():
            counted: Counter[str] = getattr(self, kind)
            for key, count in list(counted.items()):
                if count > told[key]:
                    yield kind, key, count - told[key]
            told.update(counted - told)


def line(received_ns: int, level: int, kind: str, text: str, **more: str | int) -> dict[str, Any]:
    """One line of a recording's log."""
    sec, nsec = divmod(received_ns, 10**9)
    timestamp = {"sec": sec, "nsec": nsec}
    told: dict[str, Any] = {"timestamp": timestamp, "level": level, "message": text, "name": "recorder"}
    return told | {"file": "", "line": 0, "kind": kind} | more


def line_of_loss(received_ns: int, kind: str, key: str, count: int) -> dict[str, Any]:
    """The line that tells a loss."""
    return line(received_ns, WARNING, kind, _SENTENCES[kind].format(count=count), key=key, count=count)
