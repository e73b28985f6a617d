"""What an experiment collected and trained, kept per seed and made again when the robot file changes."""

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from gemuco.dataset import Dataset
from gemuco.errors import CheckpointError, DatasetError
from gemuco.schema import BodySchema
from hal.config import RobotConfig
from services.model.artifacts import fingerprint
from services.show import Tell

Outcome = TypeVar("Outcome")


@dataclass(frozen=True, slots=True)
class Run:
    """One seed of one robot's experiments.

    Attributes:
        robot: The robot file's content.
        seed: Seed of all that is random in it.
        folder: Where its data and models are kept.
    """

    robot: RobotConfig
    seed: int
    folder: Path

    def dataset(self, name: str, make: Callable[[], Dataset], **settings: Any) -> Dataset:
        """What was collected under a name; `make` is called if it was not, or not with this robot file and settings.

        Args:
            name: Of the file, such as `nominal`.
            make: Collects.
            settings: Whatever else the data depend on (JSON values); another value makes them anew.
        """
        path, stamp = self.folder / f"{name}.npz", self._stamp(settings)
        if self._is_current(name, stamp):
            try:
                return Dataset.load(path)
            except DatasetError:
                path.unlink(missing_ok=True)
        made = make()
        made.save(path)
        self._remember(name, stamp)
        return made

    def schema(self, name: str, make: Callable[[], BodySchema], **settings: Any) -> BodySchema:
        """What was trained under a name; see `dataset`."""
        path, stamp = self.folder / name, self._stamp(settings)
        if self._is_current(name, stamp):
            try:
                return BodySchema.load(path)
            except CheckpointError:
                shutil.rmtree(path, ignore_errors=True)
        made = make()
        made.save(path)
        self._remember(name, stamp)
        return made

    def _stamp(self, settings: Mapping[str, Any]) -> str:
        content = json.dumps([fingerprint(self.robot), self.seed, settings], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def _is_current(self, name: str, stamp: str) -> bool:
        path = self.folder / f"{name}.stamp"
        return path.exists() and path.read_text() == stamp

    def _remember(self, name: str, stamp: str) -> None:
        (self.folder / f"{name}.stamp").write_text(stamp)


def open_run(robot: RobotConfig, folder: Path, seed: int, fresh: bool = False) -> Run:
    """The run of a seed under the folder of the robot's experiments; `fresh` forgets what was made before."""
    place = folder / f"seed_{seed}"
    place.mkdir(parents=True, exist_ok=True)
    if fresh:
        for stamp in place.glob("*.stamp"):
            stamp.unlink()
    return Run(robot, seed, place)


def each_seed(
    robot: RobotConfig,
    seeds: Sequence[int],
    folder: Path,
    progress: Tell,
    fresh: bool,
    experiment: Callable[[Run, Tell], Outcome],
) -> list[Outcome]:
    """One experiment for every seed, one after the other; progress is told over all of them."""
    outcomes = []
    for index, seed in enumerate(seeds):
        tell = between(progress, index / len(seeds), (index + 1) / len(seeds), f"seed {seed}: ")
        outcomes.append(experiment(open_run(robot, folder, seed, fresh), tell))
    return outcomes


def between(tell: Tell, first: float, last: float, prefix: str = "") -> Tell:
    """Progress of a part of the work, told as progress of the whole from `first` to `last`."""
    return lambda done, text: tell(first + (last - first) * done, prefix + text)
