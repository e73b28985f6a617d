"""How well joint positions are estimated with all encoders silent, before and after the online update.

    python -m benchmarks.online_update

The model is trained on the designer's geometry only (`gemuco collect`, `gemuco train`; made here if it is missing).
Then, for each of five arms that were built differently, ten simulated minutes of random motion are learned from at
10 Hz, with the settings of the robot file, and the estimate is judged on two minutes of other random motion, unloaded
and with a heavy object in the hand. The error is the mean over time of ||theta_est - theta||_2 over the five joints, as
in the paper.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from gemuco.adapt import UpdateConfig, Updater
from gemuco.dataset import Dataset
from gemuco.schema import BodySchema
from hal import registry
from hal.config import RobotConfig, load_robot
from hal.robot import Robot
from services import artifacts, collector, trainer
from services.living_model import load_model
from services.model_config import model_config
from services.playground import DirectPlayground
from simulators.direct import DirectDevice, WorldClock

HIDDEN = "joint_position"
MARKS = (0, 10, 20, 30, 60, 120, 300, 600)
"""Seconds of motion after which the model is judged."""


def motion(robot: RobotConfig, body: Robot, seed: int, rate: float, duration: float) -> Iterator[dict[str, np.ndarray]]:
    """Samples [unit] at a rate [Hz] of so much random motion [s of the arm's time]."""
    playground = DirectPlayground(body, rate)
    for command, hold in registry.load(robot.collect["motion"])(robot, seed):
        yield from playground.play(command, hold)
        if playground.elapsed() > duration:
            return


def record(
    robot: RobotConfig, arm: int, seed: int, rate: float, duration: float, part: str = ""
) -> dict[str, np.ndarray]:
    """Signal -> samples (count, n) [unit] of one actual arm."""
    world = registry.load(robot.simulator or "").world("actual", arm)
    if part:
        world.break_part(part)
    clock = WorldClock(world)
    with Robot(robot, [DirectDevice(robot, world, clock)], clock=clock, source="simulated") as body:
        rows = list(motion(robot, body, seed, rate, duration))
    return {name: np.array([row[name] for row in rows]) for name in robot.signals}


def error(schema: BodySchema, rows: dict[str, np.ndarray]) -> tuple[float, str]:
    """Mean norm of the joint error [rad] with all encoders hidden, and what it was estimated from."""
    wrong, used = [], set()
    for index in range(len(rows[HIDDEN])):
        given = {name: values[index] for name, values in rows.items() if name != HIDDEN}
        found = schema.estimate(given)[HIDDEN]
        wrong.append(np.linalg.norm(found.value - rows[HIDDEN][index]))
        used.add(f"{found.method}: {'+'.join(sorted(found.mask))}")
    return float(np.mean(wrong)), ", ".join(sorted(used))


def model(robot: RobotConfig, console: Console) -> BodySchema:
    """The trained model of the robot; collected and trained here if it is missing."""
    folder = artifacts.model_folder(robot.robot)
    if not folder.exists():
        console.print("collecting and training")
        data = artifacts.data_path(robot.robot)
        if not data.exists():
            collector.collect_direct(robot, "geometric", 0).dataset.save(data)
        trainer.train(robot, Dataset.load(data), 0, lambda *_: None).schema.save(folder)
    return load_model(robot, folder)


def run(robot: RobotConfig, arms: int, console: Console) -> dict[str, object]:
    """Errors [rad] of every arm after every mark, and with the heavy object."""
    config = model_config(robot).update
    schema = model(robot, console)
    curves, heavy = [], []
    for arm in track(range(arms), "arms", console=console):
        lived = record(robot, arm, 100 + arm, 1.0 / config.interval, MARKS[-1])
        fresh = record(robot, arm, 1000 + arm, 5.0, 120.0)
        loaded = record(robot, arm, 2000 + arm, 5.0, 120.0, "heavy_object")
        updater = Updater(schema, UpdateConfig(window=config.window, rate=config.rate))
        curve = [error(schema, fresh)[0]]
        before = error(schema, loaded)[0]
        for index in range(len(lived[HIDDEN])):
            updater.add({name: values[index] for name, values in lived.items()})
            updater.step()
            if (index + 1) * config.interval in MARKS[1:]:
                curve.append(error(updater.schema, fresh)[0])
        curves.append(curve)
        heavy.append((before, error(updater.schema, loaded)[0]))
    return {"marks": MARKS, "curves": curves, "heavy": heavy, "route": error(schema, fresh)[1]}


def show(found: dict, console: Console) -> None:
    """The table of docs/results.md."""
    table = Table(
        "arm", *(f"{mark} s" for mark in found["marks"]), "heavy, before", "heavy, after", title="joint error [rad]"
    )
    rows = [list(curve) + list(heavy) for curve, heavy in zip(found["curves"], found["heavy"], strict=True)]
    for arm, row in enumerate(rows):
        table.add_row(str(arm), *(f"{value:.3f}" for value in row))
    for label, values in (("mean", np.mean(rows, axis=0)), ("spread (std)", np.std(rows, axis=0))):
        table.add_row(label, *(f"{value:.3f}" for value in values))
    console.print(table)
    console.print(f"estimated by {found['route']}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", type=Path, default=Path("robots/musashi_arm.yaml"))
    parser.add_argument("--arms", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/online_update.json"))
    options = parser.parse_args()
    console = Console(width=140)
    result = run(load_robot(options.robot), options.arms, console)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(result, indent=1))
    show(result, console)
