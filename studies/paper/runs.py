"""Experiments of several seeds in parallel processes; data and models of each seed are cached (joblib)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import Manager
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Any, TypeVar

from joblib import Memory, Parallel, cpu_count, delayed
from joblib.externals.loky.process_executor import TerminatedWorkerError

from hal.config import RobotConfig
from services.errors import ServiceError
from services.model.artifacts import fingerprint
from services.show import Progress

Outcome = TypeVar("Outcome")
Result = TypeVar("Result")


class RunKilled(ServiceError):
    """A process of the experiments was killed."""


@dataclass(frozen=True, slots=True)
class Run:
    """One seed of one robot's experiments.

    Attributes:
        robot: The robot file's content.
        seed: Seed of all that is random in it.
        memory: Cache of its data and models.
    """

    robot: RobotConfig
    seed: int
    memory: Memory

    def cached(self, name: str, make: Callable[[], Result], **settings: Any) -> Result:
        """Return the result of `make`, from the cache if the robot file, the seed and the settings are the same.

        Args:
            name: Name of the data or the model, such as `nominal`.
            make: Collects or trains; called if the cache has no result.
            settings: All other values that the result depends on.
        """
        call = self.memory.cache(_call, ignore=["make"])
        result: Result = call(fingerprint(self.robot), self.seed, name, settings, make)
        return result


def _call(robot: str, seed: int, name: str, settings: dict[str, Any], make: Callable[[], Result]) -> Result:
    return make()


def open_run(robot: RobotConfig, folder: Path, seed: int, fresh: bool = False) -> Run:
    """Open the cache of a seed under the folder of the robot's experiments; `fresh` empties it."""
    memory = Memory(folder / f"seed_{seed}", verbose=0)
    if fresh:
        memory.clear(warn=False)
    return Run(robot, seed, memory)


Experiment = Callable[[Run, Progress], Outcome]
"""An experiment is a function of a module, so that another process can import it by its name."""


def each_seed(
    robot: RobotConfig,
    seeds: Sequence[int],
    folder: Path,
    progress: Progress,
    fresh: bool,
    experiment: Experiment[Outcome],
) -> list[Outcome]:
    """Run an experiment for every seed, one process per core; when one fails, the others are ended.

    Raises:
        RunKilled: A process was killed.
    """
    with Manager() as manager:
        reports = manager.Queue()
        relay = Thread(target=_relay, args=(reports, len(seeds), progress))
        relay.start()
        try:
            return list(
                Parallel(n_jobs=min(cpu_count(), len(seeds)))(
                    delayed(_of_seed)(experiment, open_run(robot, folder, seed, fresh), reports) for seed in seeds
                )
            )
        except TerminatedWorkerError:
            raise RunKilled(
                "A process of the experiments was killed. Is there enough memory for one process per core? Collected "
                "data and trained models are kept; `taskset -c 0` in front runs one seed at a time."
            ) from None
        finally:
            reports.put(None)
            relay.join()


def _of_seed(experiment: Experiment[Outcome], run: Run, reports: Queue[Any]) -> Outcome:
    return experiment(run, lambda done, text: reports.put((run.seed, done, text)))


def _relay(reports: Queue[Any], count: int, progress: Progress) -> None:
    """Report the mean progress of all seeds until the queue yields None."""
    shares: dict[int, float] = {}
    while (report := reports.get()) is not None:
        seed, shares[seed], text = report
        progress(sum(shares.values()) / count, f"seed {seed}: {text}")


def between(report: Progress, first: float, last: float) -> Progress:
    """Return a progress function for one part of the work, from the share `first` of the whole to `last`."""
    return lambda done, text: report(first + (last - first) * done, text)
