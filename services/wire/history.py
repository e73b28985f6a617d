"""The last minute of all estimates: a ring in the model service, and the pages of it that a client reads.

Memory is allocated once, for `WINDOW` seconds at the estimation rate, but at most `MOST_BYTES`: 2.9 MB for the 25
elements of the shipped arm at 200 Hz. A tick writes one row without a lock. A reader copies rows, and drops those that
were overwritten meanwhile.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hal.by_signal import Elements, Numbers, Truths
from services.errors import BadArguments, ServiceUnavailable, TooSlow
from services.wire.messages import Estimates

WINDOW = 60.0
"""Estimates are kept for this time [s]."""
MOST_BYTES = 1 << 24
"""The ring has at most this size; with very many signals or a high rate it holds less than a minute."""
PAGE_BYTES = 1 << 19
"""A page has at most this size, half of that of a message."""
PAGE_EVERY = 0.025
"""Queries for pages are this far apart [s]; a router passes on about 50 queries per second."""
PAGE_WITHIN = 1.0
"""A page that does not come within this time [s] is asked for again."""

Signals = Mapping[str, int]
"""Signal -> number of elements."""


class HistoryRing:
    """Rows of estimates, numbered from 0 at the start of the service.

    One thread adds rows; others may read at the same time.

    Args:
        signals: Signals of a row.
        rate: Rows per second [Hz].
    """

    def __init__(self, signals: Signals, rate: float) -> None:
        self.signals = dict(signals)
        width = sum(signals.values())
        self._row_bytes = 9 * width + 16
        self.capacity = max(1, min(round(WINDOW * rate), MOST_BYTES // self._row_bytes))
        self._values = np.zeros((self.capacity, width))
        self._estimated = np.zeros((self.capacity, width), bool)
        self._stamps = np.zeros(self.capacity, "<i8")
        self._arrived = np.zeros(self.capacity)
        self._elements = Elements.of(signals)
        self._places = self._elements.places
        self._begun = self._done = 0
        """These count the rows whose writing began, and ended; they differ only while a row is written."""

    @property
    def nbytes(self) -> int:
        """Memory of the rows [bytes]."""
        return self._values.nbytes + self._estimated.nbytes + self._stamps.nbytes + self._arrived.nbytes

    @property
    def rows(self) -> int:
        """Number of the next row."""
        return self._done

    def add(self, estimates: Estimates, now: float) -> None:
        """Write a row at monotonic time `now` [s]."""
        row = self._done % self.capacity
        self._begun = self._done + 1
        values, estimated = estimates.values, estimates.estimated
        if estimates.elements is not self._elements:
            values, estimated = Numbers.of(values, self._elements), Truths.of(estimated, self._elements)
        self._values[row], self._estimated[row] = values.flat, estimated.flat
        self._stamps[row] = estimates.stamp_ns
        self._arrived[row] = now
        self._done = self._begun

    def since(self, moment: float) -> int:
        """Return the number of the first row that was written at monotonic time `moment` [s] or later."""
        numbers = np.arange(max(0, self._begun - self.capacity), self._done)
        return int(numbers[0] + np.searchsorted(self._arrived[numbers % self.capacity], moment)) if len(numbers) else 0

    def page(self, begin: int, end: int, signals: Iterable[str]) -> dict[str, Any]:
        """Return the rows from `begin` to before `end` that fit into one page, without those that were overwritten.

        Returns:
            `begin`, `end`: numbers of the rows; `stamp_ns`, `values`, `estimated`: binaries of little-endian int64,
            float64 and bytes, the last two by signal and row after row.
        """
        names = list(signals)
        row_bytes = 8 + 9 * sum(self.signals[name] for name in names)
        begin = max(begin, self._begun - self.capacity, 0)
        end = max(begin, min(end, self._done, begin + max(1, PAGE_BYTES // row_bytes)))
        rows = np.arange(begin, end) % self.capacity
        stamps = self._stamps[rows]
        values = {name: self._values[rows, self._places[name]] for name in names}
        estimated = {name: self._estimated[rows, self._places[name]] for name in names}
        lost = min(max(0, self._begun - self.capacity - begin), end - begin)  # overwritten while they were copied
        return {
            "begin": begin + lost,
            "end": end,
            "stamp_ns": stamps[lost:].tobytes(),
            "values": {name: rows[lost:].astype("<f8", copy=False).tobytes() for name, rows in values.items()},
            "estimated": {name: rows[lost:].tobytes() for name, rows in estimated.items()},
        }

    def answer(self, arguments: Mapping[str, Any], boot: int, now: float) -> dict[str, Any]:
        """Answer the verb `history`: the last `seconds`, or rows from `begin` to `end`, of some signals or all.

        Args:
            arguments: `seconds`, or `begin` and `end`; `signals`.
            boot: `boot` of the service, so that a reader notices a restart, which numbers the rows anew.
            now: Monotonic time [s].

        Returns:
            The first page, and `last`: the row after the last one to ask for.

        Raises:
            BadArguments: An argument is malformed or missing.
        """
        names = arguments.get("signals") or list(self.signals)
        if not isinstance(names, list) or not all(isinstance(name, str) and name in self.signals for name in names):
            raise BadArguments(f"'signals' must be a list of these names: {', '.join(self.signals)}.")
        begin, end, seconds = arguments.get("begin"), arguments.get("end"), arguments.get("seconds")
        if seconds is not None:
            if not isinstance(seconds, int | float) or isinstance(seconds, bool) or not 0 < seconds < np.inf:
                raise BadArguments(f"'seconds' must be a number above 0; the last {WINDOW:g} s are kept.")
            begin, end = self.since(now - seconds), self.rows
        elif not all(isinstance(row, int) and not isinstance(row, bool) and 0 <= row < 1 << 62 for row in (begin, end)):
            raise BadArguments("'history' needs 'seconds', or rows from 'begin' to 'end'.")
        assert begin is not None
        assert end is not None
        return {
            **self.page(begin, end, names),
            "last": end,
            "boot": boot,
            "elements": {n: self.signals[n] for n in names},
        }


@dataclass(frozen=True, slots=True)
class History:
    """Recent estimates, one row per published message.

    Attributes:
        stamp_ns: The model service's wall clock [ns since 1970], shape (rows,).
        values: Signal -> measured values, with estimates where an element was not measured [unit], shape (rows, n);
            NaN where neither was possible.
        estimated: Signal -> whether each value was estimated, shape (rows, n).
    """

    stamp_ns: np.ndarray
    values: dict[str, np.ndarray]
    estimated: dict[str, np.ndarray]

    @property
    def seconds(self) -> np.ndarray:
        """Time of each row relative to the newest one [s], shape (rows,); 0 or negative."""
        return (self.stamp_ns - self.stamp_ns[-1]) * 1e-9 if len(self.stamp_ns) else np.zeros(0)


def fetch(
    ask: Callable[[dict[str, Any], float], dict[str, Any]], seconds: float, signals: Iterable[str], timeout: float
) -> History:
    """Ask for all pages and join them.

    Args:
        ask: Queries `history` with these arguments and a timeout [s].
        seconds: Length of the history [s].
        signals: Names of signals; all if empty.
        timeout: Deadline [s] for all pages.

    Raises:
        TooSlow: Not all pages came in time.
        ServiceUnavailable: The service is absent, or was restarted meanwhile.
    """
    deadline = time.monotonic() + timeout
    request: dict[str, Any] = {"seconds": float(seconds), "signals": list(signals)}
    pages: list[dict[str, Any]] = []
    while True:
        sent = time.monotonic()
        left = deadline - sent
        if left <= 0:
            raise TooSlow(
                f"The history of {seconds:g} s did not come within {timeout:g} s. Ask for less, or with a longer "
                "timeout."
            )
        try:
            page = ask(request, min(left, PAGE_WITHIN))
        except TooSlow:
            if left > PAGE_WITHIN:
                continue
            raise
        if pages and page["boot"] != pages[0]["boot"]:
            raise ServiceUnavailable("The model service was restarted while its history was read. Ask again.")
        pages.append(page)
        if page["end"] >= page["last"] or page["end"] == page["begin"]:
            return _joined(pages)
        request = {"begin": page["end"], "end": page["last"], "signals": list(page["elements"])}
        time.sleep(max(0.0, sent + PAGE_EVERY - time.monotonic()))


def _joined(pages: list[dict[str, Any]]) -> History:
    sizes: Signals = pages[0]["elements"]

    def rows(field: str, name: str, kind: str) -> np.ndarray:
        return np.concatenate([np.frombuffer(page[field][name], kind) for page in pages]).reshape(-1, sizes[name])

    return History(
        stamp_ns=np.concatenate([np.frombuffer(page["stamp_ns"], "<i8") for page in pages]),
        values={name: rows("values", name, "<f8") for name in sizes},
        estimated={name: rows("estimated", name, "?") for name in sizes},
    )
