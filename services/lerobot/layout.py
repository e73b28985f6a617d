"""Files of a dataset of LeRobot, version 3.0: data and episodes as Parquet, information, statistics, tasks."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gemuco.writing import replace
from services.errors import RecordingError

VERSION = "v3.0"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = Path("meta/episodes/chunk-000/file-000.parquet")
FIRST = Path("data/chunk-000/file-000.parquet")
OWN = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Features that every dataset has, of one number each, and their types."""
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
PANDAS = {
    "index_columns": ["task"],
    "column_indexes": [
        {"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object",
         "metadata": {"encoding": "UTF-8"}}
    ],
    "columns": [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64",
         "metadata": None},
        {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None},
    ],
    "pandas_version": "2.2.0",
}  # fmt: skip
"""LeRobot reads the tasks with pandas, by their text."""

Arrays = Mapping[str, np.ndarray]
"""Feature -> frames, shape (frames, n)."""


def arrow() -> Any:
    """Return pyarrow with its part for Parquet.

    Raises:
        RecordingError: It is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise RecordingError(
            "A dataset of LeRobot needs pyarrow, which is not installed: pip install 'gemuco[parquet]'."
        ) from None
    return pyarrow


class Writer:
    """A dataset that grows by whole episodes.

    Args:
        folder: Its folder, which does not exist.
        robot: Name of the robot.
        rate: Frames per second.
        task: What the robot does.

    Attributes:
        episodes: Number of episodes so far.
        frames: Number of their frames.
    """

    def __init__(self, folder: Path, robot: str, rate: int, task: str) -> None:
        self.episodes = self.frames = 0
        self._arrow, self._folder = arrow(), folder
        self._robot, self._rate, self._task = robot, rate, task
        self._features: dict[str, Any] = {}
        self._data: Any = None
        self._listed: list[dict[str, Any]] = []
        self._all: dict[str, list[np.ndarray]] = {}

    def add(self, episode: Mapping[str, Any]) -> None:
        """Add an episode: feature -> frames, shape (frames, n), and `names`: feature -> names of its n elements.

        Raises:
            RecordingError: It has other features than the first one.
        """
        features = {name: (str(value.dtype), episode["names"][name]) for name, value in _arrays(episode)}
        if self._features and features != self._features:
            raise RecordingError(
                "The recordings have other signals or commands than the first one. Export them one by one."
            )
        self._features = features
        count = len(next(value for _, value in _arrays(episode)))
        own: dict[str, np.ndarray] = {
            "timestamp": (np.arange(count) / self._rate).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, self.episodes),
            "index": self.frames + np.arange(count),
            "task_index": np.zeros(count, int),
        }
        arrays = {**dict(_arrays(episode)), **{name: value.reshape(-1, 1) for name, value in own.items()}}
        self._write(arrays)
        stats = {name: statistics(value) for name, value in arrays.items()}
        self._listed.append(
            {
                "episode_index": self.episodes, "tasks": [self._task], "length": count, "data/chunk_index": 0,
                "data/file_index": 0, "dataset_from_index": self.frames, "dataset_to_index": self.frames + count,
                **{f"stats/{name}/{kind}": value for name, own in stats.items() for kind, value in own.items()},
                "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
            }
        )  # fmt: skip
        for name, value in arrays.items():
            self._all.setdefault(name, []).append(value)
        self.episodes, self.frames = self.episodes + 1, self.frames + count

    def close(self) -> None:
        """Write the metadata; without it the folder is no dataset."""
        self._data.close()
        parquet, table = self._arrow.parquet, self._arrow.Table
        (self._folder / EPISODES).parent.mkdir(parents=True)
        parquet.write_table(table.from_pylist(self._listed), self._folder / EPISODES)
        tasks = table.from_pylist([{"task_index": 0, "task": self._task}])
        tasks = tasks.replace_schema_metadata({"pandas": json.dumps(PANDAS)})
        parquet.write_table(tasks, self._folder / "meta" / "tasks.parquet")
        stats = {name: statistics(np.concatenate(parts)) for name, parts in self._all.items()}
        replace(self._folder / "meta" / "stats.json", json.dumps(stats, indent=4).encode())
        replace(self._folder / "meta" / "info.json", json.dumps(self._information(), indent=4).encode())

    def _write(self, arrays: Arrays) -> None:
        pa = self._arrow
        columns = {}
        for name, value in arrays.items():
            kind = {"bool": pa.bool_(), "float32": pa.float32(), "int64": pa.int64()}[str(value.dtype)]
            flat = pa.array(value.reshape(-1), kind)
            columns[name] = flat if name in OWN else pa.FixedSizeListArray.from_arrays(flat, value.shape[1])
        rows = pa.table(columns)
        if self._data is None:
            (self._folder / FIRST).parent.mkdir(parents=True)
            self._data = pa.parquet.ParquetWriter(self._folder / FIRST, rows.schema, compression="zstd")
        self._data.write_table(rows)

    def _information(self) -> dict[str, Any]:
        features = {
            name: {"dtype": kind, "shape": [len(names)], "names": names}
            for name, (kind, names) in self._features.items()
        } | {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in OWN.items()}
        return {
            "codebase_version": VERSION, "fps": self._rate, "features": features, "total_episodes": self.episodes,
            "total_frames": self.frames, "total_tasks": 1, "chunks_size": 1000, "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200, "data_path": DATA, "video_path": None, "robot_type": self._robot,
            "splits": {"train": f"0:{self.episodes}"},
        }  # fmt: skip


def statistics(value: np.ndarray) -> dict[str, list[float]]:
    """Return min, max, mean, std, count and quantiles of every element of a feature, shape (frames, n)."""
    numbers = value.astype(float)
    return {
        "min": numbers.min(axis=0).tolist(), "max": numbers.max(axis=0).tolist(), "mean": numbers.mean(axis=0).tolist(),
        "std": numbers.std(axis=0).tolist(), "count": [len(numbers)],
        **{name: np.quantile(numbers, share, axis=0).tolist() for name, share in QUANTILES.items()},
    }  # fmt: skip


def _arrays(episode: Mapping[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    yield from ((name, value) for name, value in episode.items() if name != "names")
