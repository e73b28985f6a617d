"""Experiments of several seeds side by side, and what each collected and trained, kept for the next time.

It is made again when the robot file changes.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Queue, get_context
from multiprocessing.synchronize import Event
from pathlib import Path
from queue import Empty
from typing import Any, TypeVar

from gemuco import checkpoint
from gemuco.dataset import Dataset
from gemuco.errors import CheckpointError, DatasetError
from gemuco.learning import cores, devices
from gemuco.schema import BodySchema
from hal.config import RobotConfig
from services.errors import ServiceError
from services.learning.trainer import train_all
from services.model.artifacts import fingerprint
from services.show import Tell

Outcome = TypeVar("Outcome")
MODEL = "nominal_model"
"""What experiments on a simulated body call its model."""


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
                return checkpoint.load(path)
            except CheckpointError:
                shutil.rmtree(path, ignore_errors=True)
        made = make()
        self.keep(name, made, **settings)
        return made

    def keep(self, name: str, schema: BodySchema, **settings: Any) -> None:
        """Have `schema` find this under a name."""
        checkpoint.save(schema, self.folder / name)
        self._remember(name, self._stamp(settings))

    def has(self, name: str, **settings: Any) -> bool:
        """Whether something is kept under a name; see `dataset`."""
        return self._is_current(name, self._stamp(settings))

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


Experiment = Callable[[Run, Tell], Outcome]
"""All of one seed, as a function of a module: a process that is started for it must find it by its name."""


def each_seed(
    robot: RobotConfig,
    seeds: Sequence[int],
    folder: Path,
    progress: Tell,
    fresh: bool,
    experiment: Experiment[Outcome],
    collect: Experiment[Dataset] | None = None,
) -> list[Outcome]:
    """One experiment for every seed, as many at a time as there are cores; progress is told over all of them.

    When one fails, the others end as soon as they have something to tell. Where there is CUDA, the models of all seeds
    are trained together on what `collect` collects, and the experiments find them under the name `MODEL`.
    """
    if collect is not None and devices.best() is not None:
        datasets = each_seed(robot, seeds, folder, between(progress, 0.0, 0.2), fresh, collect)
        _train_ahead([open_run(robot, folder, seed) for seed in seeds], datasets, between(progress, 0.2, 0.4))
        progress, fresh = between(progress, 0.4, 1.0), False
    context, done = get_context("spawn"), dict.fromkeys(seeds, 0.0)
    told, stop = context.Queue(), context.Event()
    with ProcessPoolExecutor(min(cores.count(), len(seeds)), context, _join, (told, stop)) as pool:
        running = {seed: pool.submit(_of_seed, experiment, robot, folder, seed, fresh) for seed in done}
        try:
            while not all(job.done() for job in running.values()):
                for job in running.values():
                    if job.done():
                        job.result()  # raises what it raised
                with suppress(Empty):
                    seed, share, text = told.get(timeout=0.5)
                    done[seed] = share
                    progress(sum(done.values()) / len(done), f"seed {seed}: {text}")
            return [running[seed].result() for seed in seeds]
        except BrokenProcessPool:
            raise RunKilled(
                "A process of the experiments was killed. Is memory enough for as many as there are cores? What was "
                "collected and trained is kept; `taskset -c 0` in front runs one seed at a time."
            ) from None
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def _train_ahead(runs: Sequence[Run], datasets: Sequence[Dataset], progress: Tell) -> None:
    missing = [(run, data) for run, data in zip(runs, datasets, strict=True) if not run.has(MODEL)]
    if not missing:
        return
    seeds = [run.seed for run, _ in missing]
    trained = train_all(runs[0].robot, [data for _, data in missing], seeds, progress)
    for (run, _), one in zip(missing, trained, strict=True):
        run.keep(MODEL, one.schema)


class RunKilled(ServiceError):
    """A process ended without telling why."""


class Stopped(Exception):
    """The experiment of another seed failed, or whoever waits was interrupted."""


_ways: list[tuple[Queue[Any], Event]] = []
"""In a process of experiments: where to tell how far one is, and whether it is to end."""


def _join(told: Queue[Any], stop: Event) -> None:
    told.cancel_join_thread()  # nobody reads any more when a process ends
    _ways.append((told, stop))


def _of_seed(experiment: Experiment[Outcome], robot: RobotConfig, folder: Path, seed: int, fresh: bool) -> Outcome:
    told, stop = _ways[-1]

    def tell(done: float, text: str) -> None:
        if stop.is_set():
            raise Stopped
        told.put((seed, done, text))

    return experiment(open_run(robot, folder, seed, fresh), tell)


def between(tell: Tell, first: float, last: float, prefix: str = "") -> Tell:
    """Progress of a part of the work, told as progress of the whole from `first` to `last`."""
    return lambda done, text: tell(first + (last - first) * done, prefix + text)
