"""Losses of a recording, counted per key; the file has the counts as facts, and each loss with its time in its log."""

import json
from collections import Counter
from collections.abc import Iterator
from typing import Any

INFO, WARNING, ERROR = 2, 3, 4
"""These are the levels of foxglove.Log."""
LOG = "foxglove.Log"
OTHERS = "other keys"
LARGEST_JUMP = 1_000_000_000
"""A jump of a sequence number by more than this [messages] is ignored; this is two months at 200 Hz."""
SENDERS = 8
"""At most this many senders of one key are counted separately; a further sender replaces the first."""
MOST_KEYS = 1000
"""Dropped messages are counted separately for at most this many keys, because any client may make new keys."""
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
LOG_SCHEMA: dict[str, Any] = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    "title": LOG,
    "description": "Events during the recording; Foxglove shows them in its Log panel.",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "level": {"type": "integer", "description": "2 info, 3 warning, 4 error"},
        "message": {"type": "string"},
        "name": {"type": "string", "description": "The service that the line is about."},
        "file": {"type": "string"},
        "line": {"type": "integer"},
        "kind": {
            "type": "string",
            "description": "alive, gone, holder, robot, file, clock, dropped, missed, malformed",
        },
        "key": {"type": "string"},
        "count": {"type": "integer", "description": "Number of messages."},
    },
    "required": ["timestamp", "level", "message", "name", "kind"],
}
_SENTENCES = {
    "dropped": "{count} messages arrived but could not be written.",
    "missed": "{count} messages never arrived: their sequence numbers are missing.",
    "malformed": "{count} messages were not of the type of their key; their bytes are kept.",
}


class Losses:
    """Counts of missing messages, per key, over all files of a recording."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        """Messages that arrived but could not be written: too many at once, or no space."""
        self.missed: Counter[str] = Counter()
        """Messages that never came, known from gaps in the sequence numbers."""
        self.malformed: Counter[str] = Counter()
        """Messages that are not of the type of their key; their bytes are in the recording."""
        self._reported = {kind: Counter[str]() for kind in _SENTENCES}
        self._last: dict[str, dict[int, int]] = {}

    def arrived(self, key: str, boot: int, seq: int) -> None:
        """Store a sender's sequence number, and count the messages missing before this one."""
        senders = self._last.setdefault(key, {})
        last = senders.get(boot)
        if last is None:
            if len(senders) >= SENDERS:
                del senders[next(iter(senders))]
        elif seq <= last or seq - last > LARGEST_JUMP:
            return
        elif seq > last + 1:
            self.missed[key] += seq - last - 1
        senders[boot] = seq

    def drop(self, key: str, count: int = 1) -> None:
        """Count messages of a key that could not be written; they do not also count as missed."""
        self.dropped[key if key in self.dropped or len(self.dropped) < MOST_KEYS else OTHERS] += count
        self._last.pop(key, None)

    def totals(self) -> dict[str, int]:
        """Return the totals `dropped`, `missed` and `malformed` over all keys."""
        return {kind: getattr(self, kind).total() for kind in _SENTENCES}

    def facts(self) -> dict[str, str]:
        """Return the totals as text, and each kind by key as JSON."""
        totals = {kind: str(count) for kind, count in self.totals().items()}
        return totals | {f"{kind}_by_key": json.dumps(dict(getattr(self, kind))) for kind in _SENTENCES}

    def news(self) -> Iterator[tuple[str, str, int]]:
        """Yield kind, key and number of the losses since the last call."""
        for kind, reported in self._reported.items():
            counted: Counter[str] = getattr(self, kind)
            for key, count in list(counted.items()):
                if count > reported[key]:
                    yield kind, key, count - reported[key]
            reported.update(counted - reported)


def line(received_ns: int, level: int, kind: str, text: str, **more: str | int) -> dict[str, Any]:
    """Return one line of a recording's log."""
    sec, nsec = divmod(received_ns, 10**9)
    timestamp = {"sec": sec, "nsec": nsec}
    entry: dict[str, Any] = {"timestamp": timestamp, "level": level, "message": text, "name": "recorder"}
    return entry | {"file": "", "line": 0, "kind": kind} | more


def line_of_loss(received_ns: int, kind: str, key: str, count: int) -> dict[str, Any]:
    """Return the line of the log that reports a loss."""
    return line(received_ns, WARNING, kind, _SENTENCES[kind].format(count=count), key=key, count=count)
