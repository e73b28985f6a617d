"""What a robot has lived through: episodes, each under one condition of the body."""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gemuco.errors import DatasetError, NotEnoughData, SchemaError
from gemuco.signals import Layout, Signal

FORMAT = "gemuco.dataset"
VERSION = 1
MIN_EPISODES = 5
"""With fewer episodes than this, data is split by time block instead of by episode."""


@dataclass(frozen=True, slots=True)
class Episode:
    """A stretch of time under one condition.

    Attributes:
        condition: How the body is: tool, load, wear.
        values: Signal -> array [its unit], shape (samples, n); NaN where nothing was measured.
    """

    condition: str
    values: Mapping[str, np.ndarray]


@dataclass(frozen=True, slots=True)
class Dataset:
    """Episodes of one body."""

    layout: Layout
    episodes: tuple[Episode, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "episodes", tuple(self.episodes))
        for episode in self.episodes:
            if self.layout.join(episode.values).ndim != 2:
                raise DatasetError("An episode's arrays need a row per sample: shape (samples, n).")

    def __len__(self) -> int:
        """Samples in all episodes."""
        return len(self.rows())

    @property
    def conditions(self) -> tuple[str, ...]:
        """The conditions in order of first appearance."""
        return tuple(dict.fromkeys(episode.condition for episode in self.episodes))

    def rows(self) -> np.ndarray:
        """All samples [unit], shape (samples, layout.size)."""
        parts = [self.layout.join(episode.values) for episode in self.episodes]
        return np.concatenate(parts) if parts else np.zeros((0, self.layout.size))

    def condition_of_rows(self) -> np.ndarray:
        """Index into `conditions` of every row, shape (samples,)."""
        order = {condition: index for index, condition in enumerate(self.conditions)}
        parts = [np.full(len(self.layout.join(e.values)), order[e.condition]) for e in self.episodes]
        return np.concatenate(parts) if parts else np.zeros(0, int)

    def split(self, held_out: float, seed: int = 0) -> tuple["Dataset", "Dataset"]:
        """Training and held-out data, by episode, or by time block if there are few episodes.

        Never by random rows: neighbours in time are nearly equal, so a random split measures memory.

        Args:
            held_out: Share of the episodes or blocks to hold out, 0 to 1.
            seed: Which ones.

        Raises:
            NotEnoughData: Less than two episodes or blocks.
        """
        parts = self.episodes if len(self.episodes) >= MIN_EPISODES else self._blocks(10)
        if len(parts) < 2:
            raise NotEnoughData(f"{len(self)} samples cannot be split into training and held-out data; collect more.")
        order = np.random.default_rng(seed).permutation(len(parts))
        count = min(max(1, round(held_out * len(parts))), len(parts) - 1)
        away = set(order[:count].tolist())
        kept = tuple(part for index, part in enumerate(parts) if index not in away)
        return Dataset(self.layout, kept), Dataset(self.layout, tuple(parts[i] for i in sorted(away)))

    def _blocks(self, count: int) -> tuple[Episode, ...]:
        blocks: list[Episode] = []
        for episode in self.episodes:
            rows = self.layout.join(episode.values)
            for block in np.array_split(rows, min(count, len(rows) // 2 or 1)):
                blocks.append(Episode(episode.condition, self.layout.split(block)))
        return tuple(blocks)

    def save(self, path: str | Path) -> None:
        """Write one .npz file; nothing in it is pickled."""
        head = {
            "format": FORMAT,
            "version": VERSION,
            "signals": [[s.name, s.size, s.unit, list(s.elements)] for s in self.layout.signals],
            "conditions": [episode.condition for episode in self.episodes],
        }
        arrays = {f"episode_{i}": self.layout.join(e.values) for i, e in enumerate(self.episodes)}
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_name(path.name + ".draft")
        with draft.open("wb") as file:
            np.savez_compressed(file, head=np.array(json.dumps(head)), **arrays)  # type: ignore[arg-type]
        draft.replace(path)

    @classmethod
    def load(cls, path: str | Path) -> "Dataset":
        """Read what `save` wrote.

        Raises:
            DatasetError: No such file, damaged, or not a dataset of this version.
        """
        try:
            with np.load(path, allow_pickle=False) as archive:
                head = json.loads(str(archive["head"]))
                if head["format"] != FORMAT or head["version"] != VERSION:
                    raise DatasetError(f"'{path}' is {head['format']} version {head['version']}; this reads version 1.")
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
