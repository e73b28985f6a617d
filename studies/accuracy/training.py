"""Time of structure determination and training of the three robots' models, as `gemuco train` does them.

    python -m studies.accuracy.training                # with the networks of the robot files
    python -m studies.accuracy.training --published    # PR2 with the published five hidden layers of 300

Data are those of `gemuco collect` in runs/<robot>/data.npz; missing data are collected first and not counted. The CPU
time is what the work takes on a core of its own; other programs on the machine add to the wall time.
"""

import argparse
import time

from rich.console import Console
from rich.table import Table

from gemuco.dataset import Dataset
from hal.config import RobotConfig, load_robot
from services.learning import collector, trainer
from services.model import artifacts
from services.show import progress

ROBOTS = ("pr2_duster", "musashi_arm", "kxr_humanoid")
BAR = 240.0
"""Limit of the training time of all three robots [s]."""
PUBLISHED = {
    "pr2_duster": {
        "network": {"hidden": [300, 300], "latent": 300, "bias": 2},
        "structure": {"epochs": 20},
        "training": {"epochs": 100, "batch": 100, "rate": 3e-3},
    }
}
"""RA-L 2021: seven layers, five hidden ones of 300, p of 2. Epochs, batch and rate are ours."""


def data_of(robot: RobotConfig) -> Dataset:
    """Load the robot's data, or collect them."""
    path = artifacts.data_path(robot.robot)
    return Dataset.load(path) if path.exists() else collector.collect_direct(robot).dataset


def main() -> None:
    """Train all robots and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--published", action="store_true", help="PR2 with the published network")
    parser.add_argument("--robots", nargs="+", default=ROBOTS, choices=ROBOTS)
    chosen = parser.parse_args()
    console = Console()
    table = Table("robot", "samples", "network", "wall [s]", "CPU [s]", "held-out loss", "rejected", "skipped")
    wall_sum = cpu_sum = 0.0
    for name in chosen.robots:
        robot = load_robot(artifacts.robot_file(name))
        if chosen.published and name in PUBLISHED:
            robot = robot.model_copy(update={"model": {**robot.model, **PUBLISHED[name]}})
        dataset = data_of(robot)
        with progress(name, console) as report:
            wall, cpu = time.monotonic(), time.process_time()
            trained = trainer.train(robot, dataset, 0, report)
            wall, cpu = time.monotonic() - wall, time.process_time() - cpu
        wall_sum, cpu_sum = wall_sum + wall, cpu_sum + cpu
        layers = trained.schema.weights.whole
        shape = "-".join(str(n) for n in (layers[0].matrix.shape[0], *(len(layer.offset) for layer in layers)))
        history = trained.history
        counts = (f"{history.best:.4f}", str(history.rejected), str(history.skipped))
        table.add_row(name, str(len(dataset)), shape, f"{wall:.0f}", f"{cpu:.0f}", *counts)
    table.add_row("together", "", "", f"{wall_sum:.0f}", f"{cpu_sum:.0f}", f"bar {BAR:.0f} s", "", "")
    console.print(table)


if __name__ == "__main__":
    main()
