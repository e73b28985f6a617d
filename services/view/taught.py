"""File of taught samples, which grows by one sample at a time and is never overwritten."""

import fcntl
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.signals import Layout, Signal
from services.errors import ServiceError
from services.watch.snapshot import RobotSnapshot

LONGEST_NAME = 60
"""Names of conditions have at most this number of letters."""
FRESH = 0.25
"""A sample is the present posture up to this age [s]."""


class NotRecorded(ServiceError):
    """Error for a sample that was not written; the file is unchanged, and the text gives the reason."""


def posture(snapshot: RobotSnapshot) -> tuple[Layout, dict[str, np.ndarray]]:
    """Return the signals of the robot and their present values [their unit].

    Raises:
        NotRecorded: An element is not measured at present.
    """
    signals = snapshot.hal.get("signals")
    if not signals:
        raise NotRecorded("The HAL has not described its signals yet, so nothing was recorded. Is it running?")
    layout = Layout(tuple(Signal(n, len(s["elements"]), s["unit"], tuple(s["elements"])) for n, s in signals.items()))
    values: dict[str, np.ndarray] = {}
    for name, about in signals.items():
        newest = snapshot.vision if about.get("source") == "vision" else snapshot.sample
        sample = None if newest is None or newest.age > FRESH else newest.message
        if sample is None or name not in sample.values:
            raise NotRecorded(f"'{name}' is not measured now, so nothing was recorded.")
        missing = np.flatnonzero(~(sample.valid[name] & np.isfinite(sample.values[name])))
        if missing.size:
            elements = ", ".join(about["elements"][index] for index in missing)
            raise NotRecorded(f"{name} ({elements}) is not measured now, so nothing was recorded.")
        values[name] = np.array(sample.values[name], float)
    return layout, values


class TaughtFile:
    """Samples of taught postures, in the format that `gemuco train --data` reads.

    Every sample is written at once, to a draft that replaces the file. Earlier samples stay. A lock makes
    processes that record into the same file wait for each other.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._own: list[np.ndarray] = []
        """Rows that this object recorded, in the order of the file."""
        self._in_episode = ""
        """Condition of the episode that this object began last."""

    @property
    def recorded(self) -> int:
        """Number of samples that this object recorded and did not take back."""
        return len(self._own)

    def add(self, condition: str, layout: Layout, values: Mapping[str, np.ndarray]) -> int:
        """Write one more sample and return the number of samples in the file.

        Args:
            condition: Condition of the body, such as its tool.
            layout: Layout of the signals.
            values: Signal -> present value [its unit], shape (n,).

        Raises:
            NotRecorded: The name is missing, a value is not finite, or the file has other signals.
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
            if self._in_episode == name and episodes and self._ends_with_own(dataset):
                rows = np.vstack([layout.join(episodes.pop().values), row])
            else:
                rows = row[None]
            episodes.append(Episode(name, layout.split(rows)))
            grown = Dataset(layout, tuple(episodes))
            grown.save(self.path)
        self._in_episode = name
        self._own.append(row)
        return len(grown)

    def undo(self) -> int:
        """Remove the last sample that this object recorded and return the number of samples left.

        Raises:
            NotRecorded: There is none, or another process recorded after it.
        """
        if not self._own:
            raise NotRecorded("There is nothing to take back: samples from before this page was started stay.")
        with self._locked():
            dataset = self._load(None)
            if not self._ends_with_own(dataset):
                raise NotRecorded(f"'{self.path}' ends with a sample of another process, so nothing was taken back.")
            *kept, last = dataset.episodes
            rows = dataset.layout.join(last.values)[:-1]
            if len(rows):
                kept.append(Episode(last.condition, dataset.layout.split(rows)))
            else:
                self._in_episode = ""
            left = Dataset(dataset.layout, tuple(kept))
            left.save(self.path)
        self._own.pop()
        return len(left)

    def _ends_with_own(self, dataset: Dataset) -> bool:
        rows = dataset.rows()
        return bool(self._own and len(rows) and np.array_equal(rows[-1], self._own[-1]))

    def _load(self, layout: Layout | None) -> Dataset:
        """Return the samples in the file; with a layout, none if there is no file."""
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
            lock = self.path.with_name(self.path.name + ".lock").open("a")
        except OSError as error:
            raise NotRecorded(f"'{self.path}' cannot be written: {error.strerror}.") from None
        with lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
