"""How long until everything is valid again after `kill -9` of a process and its restart, its start included.

    python -m studies.stack.restarts --times 5

The arm is engaged and following when a process dies. After the service's death the time is also taken until the HAL
follows its last command no more.
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
from services.process.supervisor import Supervisor, gemuco_command
from studies.accuracy.actual_arms import model
from studies.stack.loops import engage, measures


def until(condition: Callable[[], bool], limit: float = 30.0) -> float:
    """Seconds until a condition holds."""
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > limit:
            raise TimeoutError(f"It did not happen within {limit:g} s.")
        time.sleep(0.002)
    return time.monotonic() - began


def gone(client: Client) -> bool:
    """Whether no estimate that stands on measurements reaches this process."""
    estimate = client.estimate(max_age=0.1)
    return estimate is None or set(estimate.method.values()) == {"none"}


def run(robot_file: Path, times: int) -> dict[str, list[float]]:
    """Process or event -> seconds, one per try."""
    robot = load_robot(robot_file)
    model(robot, Console())
    commands = {
        "simulate": gemuco_command("simulate", str(robot_file), "--variant", "actual", "--seed", "1"),
        "hal": gemuco_command("hal", str(robot_file)),
        "serve": gemuco_command("serve", str(robot_file)),
    }
    found: dict[str, list[float]] = {name: [] for name in (*commands, "serve: not followed any more")}
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
                    found["serve: not followed any more"].append(held)
                until(lambda: gone(client))
                supervisor.start(name, command)
                found[name].append(until(lambda: not gone(client) and measures(client)))
                until(lambda: (applied := client.applied()) is not None and applied.mode in ("off", "fault"))
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", type=Path, default=Path("robots/musashi_arm.yaml"))
    parser.add_argument("--times", type=int, default=5)
    options = parser.parse_args()
    table = Table("killed", "median [s]", "worst [s]", "times")
    for event, seconds in run(options.robot, options.times).items():
        table.add_row(event, f"{np.median(seconds):.2f}", f"{max(seconds):.2f}", str(len(seconds)))
    Console().print(table)
