"""Time of data collection, structure determination and training of the three robots' models.

    python -m studies.speed.learning_time [--samples 500]

Collection is without a bus, one condition, best of three runs, in times real time by the wall clock and by CPU time.
Training is on the data of `gemuco collect` in runs/<robot>/data.npz; missing data are collected first and not counted.
Other programs on the machine increase the wall time, but not the CPU time.
"""

import argparse
import time

from rich.console import Console
from rich.table import Table

from gemuco.dataset import Dataset
from hal.config import RobotConfig, load_robot
from services.hardware.stand_in import condition_of
from services.learning import trainer
from services.learning.collector import Request, collect_direct
from services.model import artifacts
from services.show import progress

ROBOTS = ("pr2_duster", "musashi_arm", "kxr_humanoid")
RUNS = 3


def collect(robot: RobotConfig, samples: int) -> tuple[float, float]:
    """Return the speed of collection in times real time, by wall clock and by CPU, of the run with the least CPU."""
    condition = condition_of(robot, None)
    speeds = []
    for _ in range(RUNS):
        cpu = time.process_time()
        result = collect_direct(robot, request=Request((condition,) if condition else (), samples))
        cpu = time.process_time() - cpu
        speeds.append((result.robot_time / cpu, result.robot_time / result.wall_time))
    by_cpu, by_wall = max(speeds)
    return by_wall, by_cpu


def data_of(robot: RobotConfig) -> Dataset:
    """Load the robot's data, or collect them."""
    path = artifacts.data_path(robot.robot)
    return Dataset.load(path) if path.exists() else collect_direct(robot).dataset


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=500, help="of the measured collection")
    parser.add_argument("--robots", nargs="+", default=ROBOTS, choices=ROBOTS)
    options = parser.parse_args()
    console = Console()
    table = Table(
        "robot", "collection, x real time", "by CPU", "samples", "training, wall [s]", "CPU [s]", "held-out loss"
    )
    for name in options.robots:
        robot = load_robot(artifacts.robot_file(name))
        speeds = [f"{speed:.0f}" for speed in collect(robot, options.samples)]
        dataset = data_of(robot)
        with progress(name, console) as report:
            wall, cpu = time.monotonic(), time.process_time()
            trained = trainer.train(robot, dataset, 0, report)
            times = [f"{took:.0f}" for took in (time.monotonic() - wall, time.process_time() - cpu)]
        table.add_row(name, *speeds, str(len(dataset)), *times, f"{trained.history.best:.4f}")
    console.print(table)
