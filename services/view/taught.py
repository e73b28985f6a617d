"""A file of taught samples, which grows by one at a time and is never overwritten."""

import fcntl
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.signals import Layout, Signal
from services.errors import ServiceError
from services.watch.snapshot import Snapshot

LONGEST_NAME = 60
FRESH = 0.25
"""A sample older than this [s] is not the present posture."""


class NotRecorded(ServiceError):
    """Nothing was written, and what is in the file stays; the text says why."""


def posture(snapshot: Snapshot) -> tuple[Layout, dict[str, np.ndarray]]:
    """The present value [its unit] of every signal that the robot has.

    Raises:
        NotRecorded: Something is not measured now.
    """
    signals = snapshot.hal.get("signals")
    if not signals:
        raise NotRecorded("The HAL has not told its signals yet, so there is nothing to record. Is it running?")
    layout = Layout(tuple(Signal(n, len(s["elements"]), s["unit"], tuple(s["elements"])) for n, s in signals.items()))
    values: dict[str, np.ndarray] = {}
    for name, about in signals.items():
        heard = snapshot.vision if about.get("source") == "vision" else snapshot.sample
        sample = None if heard is None or heard.age > FRESH else heard.message
        if sample is None or name not in sample.values:
            raise NotRecorded(f"'{name}' is not measured now, so nothing was recorded.")
        wrong = np.flatnonzero(~(sample.valid[name] & np.isfinite(sample.values[name])))
        if wrong.size:
            elements = ", ".join(about["elements"][index] for index in wrong)
            raise NotRecorded(f"{name} ({elements}) is not measured now, so nothing was recorded.")
        values[name] = np.array(sample.values[name], float)
    return layout, values


class TaughtFile:
    """Samples of taught postures, in the form that `gemuco train --data` reads.

    Every sample is written at once, to a draft that takes the file's place; what was in the file stays in it. Another
    process that records into the same file is waited for.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._mine: list[np.ndarray] = []
        """Rows that were recorded here, in the order of the file's end."""
        self._in_episode = ""
        """The condition of the episode that was begun here and goes on."""

    @property
    def recorded(self) -> int:
        """How many samples were recorded here and not taken back."""
        return len(self._mine)

    def add(self, condition: str, layout: Layout, values: Mapping[str, np.ndarray]) -> int:
        """Write one more sample, and tell how many are in the file.

        Args:
            condition: How the body is now, such as its tool.
            layout: The signals.
            values: Signal -> present value [its unit], shape (n,).

        Raises:
            NotRecorded: No name, a value that is none, or a file that does not fit.
        """
        name = condition.strip()
        if not name or len(name) > LONGEST_NAME or not name.isprintable():
            raise NotRecorded(f"A condition needs a name of 1 to {LONGEST_NAME} letters, such as the tool's.")
        row = layout.join(values)
        if not np.isfinite(row).all():
            raise NotRecorded(
                f"{layout.element(int(np.argmin(np.isfinite(row))))} is not a number; nothing was recorded."
            )
        with self._locked():
            dataset = self._load(layout)
            episodes = list(dataset.episodes)
            if self._in_episode == name and episodes and self._ends_with_mine(dataset):
                rows = np.vstack([layout.join(episodes.pop().values), row])
            else:
                rows = row[None]
            episodes.append(Episode(name, layout.split(rows)))
            grown = Dataset(layout, tuple(episodes))
            grown.save(self.path)
        self._in_episode = name
        self._mine.append(row)
        return len(grown)

    def undo(self) -> int:
        """Take the last sample that was recorded here out of the file, and tell how many are left.

        Raises:
            NotRecorded: There is none, or somebody else recorded after it.
        """
        if not self._mine:
            raise NotRecorded("There is nothing to take back: what was recorded before this page began stays.")
        with self._locked():
            dataset = self._load(None)
            if not self._ends_with_mine(dataset):
                raise NotRecorded(f"'{self.path}' ends with somebody else's sample, so nothing was taken back.")
            *kept, last = dataset.episodes
            rows = dataset.layout.join(last.values)[:-1]
            if len(rows):
                kept.append(Episode(last.condition, dataset.layout.split(rows)))
            else:
                self._in_episode = ""
            left = Dataset(dataset.layout, tuple(kept))
            left.save(self.path)
        self._mine.pop()
        return len(left)

    def _ends_with_mine(self, dataset: Dataset) -> bool:
        rows = dataset.rows()
        return bool(self._mine and len(rows) and np.array_equal(rows[-1], self._mine[-1]))

    def _load(self, layout: Layout | None) -> Dataset:
        """What is in the file; nothing yet if there is none and a layout is told."""
        if layout is not None and not self.path.exists():
            return Dataset(layout, ())
        dataset = Dataset.load(self.path)
        if layout is not None and dataset.layout != layout:
            raise NotRecorded(
                f"'{self.path}' holds other signals ({', '.join(dataset.layout.names)}), so nothing was recorded. "
                "Move it away."
            )
        return dataset

    @contextmanager
    def _locked(self) -> Iterator[None]:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            lock = self.path.with_name(self.path.name + ".lock").open("w")
        except OSError as error:
            raise NotRecorded(f"'{self.path}' cannot be written: {error.strerror}.") from None
        with lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
