"""`gemuco reproduce`: the paper's experiments (section III) on our robots, its figures beside ours."""

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from services.errors import BadArguments
from services.show import Progress
from studies.paper.report import Report

EXPERIMENTS = ("pr2", "musashi", "kxr")


class Experiment(Protocol):
    """The function `reproduce` of each robot's module `experiment`."""

    def __call__(self, seeds: Sequence[int], folder: Path, progress: Progress, fresh: bool) -> Report:
        """Run every experiment of one robot.

        Args:
            seeds: Seeds of the runs; all have the same settings.
            folder: Folder of data, models, figures and the report.
            progress: Receives the share done, 0 to 1, and a line of text.
            fresh: Collect and train again, even if data and models are cached.
        """
        ...


def experiment(name: str) -> Experiment:
    """Return the experiments on a robot: `pr2`, `musashi` or `kxr`.

    Raises:
        BadArguments: There are no experiments of this name.
    """
    if name not in EXPERIMENTS:
        raise BadArguments(f"There are no experiments '{name}'. Known: {', '.join(EXPERIMENTS)}.")
    reproduce: Experiment = importlib.import_module(f"studies.paper.{name}.experiment").reproduce
    return reproduce
