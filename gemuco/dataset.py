"""Recorded data of one body: episodes, each under one condition."""

import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gemuco.errors import DatasetError, NotEnoughData, SchemaError, WrongSize, check_kind, described
from gemuco.signals import Layout, Signal
from gemuco.splits.division import Division
from gemuco.writing import replacing, writing

FORMAT = "gemuco.dataset"
VERSION = 1


@dataclass(frozen=True, slots=True)
class Episode:
    """A recording under one condition.

    Attributes:
        condition: State of the body: tool, load, wear.
        values: Signal -> array [its unit], shape (samples, n); NaN where nothing was measured.
    """

    condition: str
    values: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        check_kind("The condition of an episode", self.condition, str, "text")
        check_kind("The values of an episode", self.values, Mapping, "a mapping of signal -> array")


@dataclass(frozen=True, slots=True)
class Dataset:
    """Episodes of one body."""

    layout: Layout
    episodes: tuple[Episode, ...]
    _divisions: dict[str, Division] = field(init=False, repr=False, compare=False, default_factory=dict)

    def __post_init__(self) -> None:
        check_kind("The layout of a dataset", self.layout, Layout, "a Layout")
        check_kind("The episodes of a dataset", self.episodes, (tuple, list), "a tuple of Episode")
        object.__setattr__(self, "episodes", tuple(self.episodes))
        for episode in self.episodes:
            check_kind("Every entry of a dataset", episode, Episode, "an Episode")
            if self.layout.join(episode.values).ndim != 2:
                raise DatasetError("An episode's arrays need a row per sample: shape (samples, n).")

    def __len__(self) -> int:
        """Return the number of samples in all episodes."""
        return len(self.rows())

    @property
    def conditions(self) -> tuple[str, ...]:
        """Conditions in order of first appearance."""
        return tuple(dict.fromkeys(episode.condition for episode in self.episodes))

    def rows(self) -> np.ndarray:
        """Return all samples [unit], shape (samples, layout.size); NaN where no finite value was measured."""
        parts = [self.layout.join(episode.values) for episode in self.episodes]
        rows = np.concatenate(parts) if parts else np.zeros((0, self.layout.size))
        rows[~np.isfinite(rows)] = np.nan
        return rows

    def condition_of_rows(self) -> np.ndarray:
        """Return the index into `conditions` of every row, shape (samples,)."""
        order = {condition: index for index, condition in enumerate(self.conditions)}
        parts = [np.full(len(self.layout.join(e.values)), order[e.condition]) for e in self.episodes]
        return np.concatenate(parts) if parts else np.zeros(0, int)

    def split(self, held_out: float, seed: int = 0) -> tuple["Dataset", "Dataset"]:
        """Split every condition into training and held-out data, by episodes, or by time blocks if there are few.

        A split by random rows would only measure memory, because neighbours in time are nearly equal. For the same
        reason repetitions of a motion are held out together, and the rows beside a held-out block are left out.

        Args:
            held_out: Share of the motions to hold out, 0 to 1; at least one of every condition.
            seed: Seed of the draw. Successive seeds hold out other motions, until each was held out once.

        Raises:
            NotEnoughData: A condition has less than two samples, or there is no sample.
        """
        training: list[Episode] = []
        held: list[Episode] = []
        for condition in self.conditions:
            recordings, division = self._recordings(condition), self._division(condition)
            if len(division.parts) < 2:
                raise NotEnoughData(
                    f"Condition '{condition}' has {sum(map(len, recordings))} samples; they cannot be split into "
                    "training and held-out data. Collect more of it, or leave it out."
                )
            chosen = division.held(held_out, seed)
            for parts, episodes in (
                (division.trained(chosen), training),
                ([division.parts[index] for index in sorted(chosen)], held),
            ):
                for part in parts:
                    rows = recordings[part.recording][part.start : part.stop]
                    episodes.append(Episode(condition, self.layout.split(rows)))
        if not training:
            raise NotEnoughData("There are no samples to train from; record some with `gemuco collect`.")
        return Dataset(self.layout, tuple(training)), Dataset(self.layout, tuple(held))

    def repetitions(self) -> tuple[str, ...]:
        """Return sentences on the motions that the episodes repeat; `split` holds repetitions out together."""
        return tuple(note for condition in self.conditions for note in self._division(condition).notes(condition))

    def _recordings(self, condition: str) -> list[np.ndarray]:
        """Return the samples of every episode of a condition that has any [unit], shape (samples, layout.size)."""
        parts = [self.layout.join(episode.values) for episode in self.episodes if episode.condition == condition]
        return [np.where(np.isfinite(rows), rows, np.nan) for rows in parts if len(rows)]

    def _division(self, condition: str) -> Division:
        """Return the parts of a condition that a split does not divide."""
        if condition not in self._divisions:
            spans = {name: self.layout.slice(name) for name in self.layout.names}
            self._divisions[condition] = Division.of(self._recordings(condition), spans)
        return self._divisions[condition]

    def with_layout(self, layout: Layout) -> "Dataset":
        """Return the episodes with the signals of another layout, in its order.

        Raises:
            DatasetError: A signal is not in the data, or its unit or elements in the data differ.
        """
        if layout == self.layout:
            return self
        for signal in layout.signals:
            if signal.name not in self.layout.names:
                raise DatasetError(
                    f"Signal '{signal.name}' is not in the data. Its signals: {', '.join(self.layout.names)}."
                )
            recorded = self.layout.signal(signal.name)
            if recorded.unit != signal.unit:
                raise DatasetError(
                    f"Signal '{signal.name}' is in {recorded.unit} in the data, but must be in {signal.unit}. "
                    "Convert the data, or state the unit they have."
                )
            if recorded.elements != signal.elements:
                raise DatasetError(
                    f"Signal '{signal.name}' has the elements {', '.join(recorded.elements)} in the data, but must "
                    f"have {', '.join(signal.elements)}."
                )
        index = np.concatenate([np.arange(self.layout.size)[self.layout.slice(name)] for name in layout.names])
        parts = [Episode(e.condition, layout.split(self.layout.join(e.values)[:, index])) for e in self.episodes]
        return Dataset(layout, tuple(parts))

    def save(self, path: str | Path) -> None:
        """Write one .npz file without pickled objects, in one step."""
        head = {
            "format": FORMAT,
            "version": VERSION,
            "signals": [[s.name, s.size, s.unit, list(s.elements)] for s in self.layout.signals],
            "conditions": [episode.condition for episode in self.episodes],
        }
        arrays = {f"episode_{i}": self.layout.join(e.values) for i, e in enumerate(self.episodes)}
        path = Path(path)
        with writing("The data", path), replacing(path) as file:
            np.savez_compressed(file, head=np.array(json.dumps(head)), **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | Path) -> "Dataset":
        """Read a dataset that `save` wrote.

        Raises:
            DatasetError: The file is missing, damaged, or not a dataset of this version.
        """
        try:
            with np.load(path, allow_pickle=False) as archive:
                head = json.loads(str(archive["head"]))
                if head["format"] != FORMAT or head["version"] != VERSION:
                    raise DatasetError(
                        f"'{path}' is {head['format']} version {head['version']}; this gemuco reads {VERSION}."
                    )
                layout = Layout(tuple(Signal(n, size, unit, tuple(e)) for n, size, unit, e in head["signals"]))
                episodes = tuple(
                    Episode(condition, layout.split(archive[f"episode_{i}"]))
                    for i, condition in enumerate(head["conditions"])
                )
            return cls(layout, episodes)
        except FileNotFoundError:
            raise DatasetError(f"There is no data file '{path}'. Record one with `gemuco collect`.") from None
        except DatasetError:
            raise
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, SchemaError) as error:
            raise DatasetError(
                f"'{path}' is not a readable dataset ({type(error).__name__}); record it again."
            ) from None


Arrays = Mapping[str, np.ndarray]
"""An episode of plain data maps a signal to an array [its unit], shape (samples, n), or (samples,) for one element."""
Data = Dataset | Arrays | Sequence[Arrays] | Mapping[str, Arrays | Sequence[Arrays]]
"""Data are a dataset or plain: an episode, a sequence of episodes, or a mapping of condition -> episodes."""
CONDITION = "default"
"""Plain data without a condition get this one."""


def as_dataset(data: Data, units: Mapping[str, str] | None = None) -> Dataset:
    """Return data as a dataset.

    Args:
        data: A dataset, which is returned as it is; or one episode, a sequence of episodes, or a mapping of condition
            -> episodes, each episode a mapping of signal -> array, shape (samples, n) or (samples,).
        units: Signal -> unit, of plain data.

    Raises:
        WrongKind: The data have another form.
        DatasetError: A unit is missing or superfluous.
        UnknownSignal: An episode has a signal that the first one lacks.
        WrongSize: Arrays do not fit each other.
    """
    if isinstance(data, Dataset):
        return data
    episodes = [
        (condition, {name: _column(name, array) for name, array in values.items()})
        for condition, values in _plain_episodes(data)
    ]
    if not episodes:
        raise NotEnoughData("The data hold no episode.")
    return Dataset(_layout(episodes[0][1], units or {}), tuple(Episode(*episode) for episode in episodes))


def _plain_episodes(data: object) -> list[tuple[str, Arrays]]:
    """Return (condition, values) of every episode."""
    parts = data
    if isinstance(data, Mapping):
        is_named = any(_is_episodes(part) for part in data.values())
        parts = data if is_named else {CONDITION: data}
    elif isinstance(data, Sequence) and not isinstance(data, str):
        parts = {CONDITION: data}
    check_kind("The data", parts, Mapping, "a Dataset, a mapping of signal -> array, or a list of such mappings")
    episodes: list[tuple[str, Arrays]] = []
    for condition, part in parts.items():  # type: ignore[attr-defined]
        for values in [part] if isinstance(part, Mapping) else part:
            check_kind(f"An episode of condition '{condition}'", values, Mapping, "a mapping of signal -> array")
            episodes.append((condition, values))
    return episodes


def _is_episodes(part: object) -> bool:
    """Whether a value of a mapping is an episode or a list of episodes, and not an array."""
    first = part[0] if isinstance(part, list | tuple) and len(part) else part
    return isinstance(first, Mapping)


def _column(name: str, array: object) -> np.ndarray:
    """Return the samples of a signal as an array, shape (samples, n)."""
    try:
        rows = np.asarray(array, float)
    except (TypeError, ValueError):
        raise WrongSize(f"Signal '{name}' needs an array of numbers, not {described(array)}.") from None
    if rows.ndim not in (1, 2):
        raise WrongSize(f"Signal '{name}' needs an array of shape (samples, n), not {rows.shape}.")
    return rows.reshape(len(rows), -1)


def _layout(values: Arrays, units: Mapping[str, str]) -> Layout:
    check_kind("The units", units, Mapping, "a mapping of signal -> unit")
    for name in values:
        if name not in units:
            raise DatasetError(
                f"Signal '{name}' has no unit; give the units of plain data, such as units={{'{name}': 'rad'}}."
            )
    for name in units:
        if name not in values:
            raise DatasetError(f"A unit of '{name}' is given, but the data hold {', '.join(values)}.")
    return Layout(tuple(Signal(name, array.shape[1], units[name]) for name, array in values.items()))
