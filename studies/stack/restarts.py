"""Time until every signal is valid again after `kill -9` of a process and its restart, its start included.

    python -m studies.stack.restarts --times 5

The arm is engaged and following when a process dies. After the death of the service, the time is also taken until the
HAL no longer follows its last command.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from hal.config import load_robot
from services.client import Client
from services.process.supervisor import Supervisor
from studies.bodies.actual_arms import model
from studies.stack.driving import engage, measures
from studies.stack.loops import stack


def until(condition: Callable[[], bool], limit: float = 30.0) -> float:
    """Return the seconds until a condition holds.

    Raises:
        TimeoutError: It did not hold within the limit [s].
    """
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > limit:
            raise TimeoutError(f"The condition did not hold within {limit:g} s.")
        time.sleep(0.002)
    return time.monotonic() - began


def gone(client: Client) -> bool:
    """Whether this process receives no estimate that is based on measurements."""
    estimate = client.estimate(max_age=0.1)
    return estimate is None or set(estimate.method.values()) == {"none"}


def run(robot_file: Path, times: int) -> dict[str, list[float]]:
    """Return process or event -> seconds, one per try."""
    robot = load_robot(robot_file)
    model(robot, Console())
    commands = stack(robot_file, with_bus=True)
    seconds: dict[str, list[float]] = {name: [] for name in (*commands, "serve: no longer followed")}
    with Supervisor(Path("runs/restarts")) as supervisor, Client(robot.robot) as client:
        for name, command in commands.items():
            supervisor.start(name, command)
        until(lambda: measures(client))
        for _ in range(times):
            for name, command in commands.items():
                engage(client)
                client.target("joint_position", np.array([-0.3, -0.2, 0.1, -0.9, 0.1]))
                until(lambda: (applied := client.applied()) is not None and applied.mode == "follow")
                supervisor.kill(name)
                if name == "serve":
                    held = until(lambda: (applied := client.applied()) is None or applied.mode != "follow")
                    seconds["serve: no longer followed"].append(held)
                until(lambda: gone(client))
                supervisor.start(name, command)
                seconds[name].append(until(lambda: not gone(client) and measures(client)))
                until(lambda: (applied := client.applied()) is not None and applied.mode in ("off", "fault"))
    return seconds


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", type=Path, default=Path("robots/musashi_arm.yaml"))
    parser.add_argument("--times", type=int, default=5)
    options = parser.parse_args()
    table = Table("killed", "median [s]", "worst [s]", "times")
    for event, seconds in run(options.robot, options.times).items():
        table.add_row(event, f"{np.median(seconds):.2f}", f"{max(seconds):.2f}", str(len(seconds)))
    Console().print(table)
