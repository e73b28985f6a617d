"""How many samples it takes to recognise a tool, and how long a sample takes: Kalman, Gauss-Newton, gradient descent.

    python -m studies.accuracy.recognise pr2_duster|kxr_humanoid [--runs 10] [--hide tool_tip_position]

A model is trained on the designer's forecast of random postures (no noise). Then the tool is another one than the model
believes. Samples come from a random walk. A tool counts as recognised from the sample after which p stays nearer to its
trained p than to any other's; the error is how far the tool tip is from where the model predicts it from the joints
alone, at random postures, under the p found after so many samples.
"""

import argparse
import time
from itertools import chain, combinations

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.recognise import Prior
from gemuco.adaption.update import Updater
from gemuco.dataset import Dataset, Episode
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.schema import BodySchema
from gemuco.signals import Layout, Signal
from hal import registry
from hal.config import RobotConfig, load_robot
from services.model.artifacts import robot_file
from services.model.model_config import collect_config, model_config

TIP = "tool_tip_position"
AFTER = (1, 2, 5, 10, 20, 35)
WAYS = {
    "ekf": UpdateConfig(what="bias"),
    "gauss_newton": UpdateConfig(what="bias", bias_method="gauss_newton"),
    "gradient, 10 steps": UpdateConfig(what="bias", bias_method="gradient", steps=10, minimum=1, replay=0, held_out=0),
    "gradient, 1 step": UpdateConfig(what="bias", bias_method="gradient", steps=1, minimum=1, replay=0, held_out=0),
}


def names_of(robot: RobotConfig) -> tuple[str, ...]:
    """The signals of the model."""
    return model_config(robot).signals or tuple(robot.signals)


def postures(
    robot: RobotConfig, condition: str, count: int, random: np.random.Generator, step: float | None = None
) -> dict[str, np.ndarray]:
    """Forecast signals (count, n) at independent postures, or along a walk with steps of a share of the range."""
    collect, limits = collect_config(robot), robot.limits[robot.command.signal]
    low, high = np.array(limits.low), np.array(limits.high)
    command = random.uniform(low, high, (10 * count + 200, len(low)))
    if step is not None:
        moves = step * (high - low) * random.standard_normal(command.shape)
        for index in range(1, len(command)):
            command[index] = np.clip(command[index - 1] + moves[index], low, high)
    told = registry.load(collect.forecast or "")(robot, condition, command)
    fits = np.ones(len(command), bool)
    for name, bounds in collect.constraints.items():
        fits &= ((told[name] >= np.array(bounds.low)) & (told[name] <= np.array(bounds.high))).all(axis=1)
    return {name: told[name][fits][:count] for name in names_of(robot)}


def trained(robot: RobotConfig) -> BodySchema:
    """A model under all masks that contain the command."""
    names, command = names_of(robot), robot.command.signal
    layout = Layout(tuple(Signal(n, robot.signals[n].size, robot.signals[n].unit) for n in names))
    others = [name for name in names if name != command]
    masks = [{command, *part} for part in chain(*(combinations(others, k) for k in range(len(others))))]
    random = np.random.default_rng(0)
    episodes = [Episode(c, postures(robot, c, 250, random)) for c in robot.conditions for _ in range(4)]
    config = TrainConfig(hidden=(128, 128), latent=16, bias_size=2, epochs=200, batch=250, rate=5e-3)
    return fit(Dataset(layout, tuple(episodes)), config, masks, x_out=others)[0]


def tip_error(schema: BodySchema, fresh: dict[str, np.ndarray], command: str) -> float:
    """Mean distance [mm] of the tip from where it is predicted from the joints."""
    x = schema.normalise(fresh)
    span, out = schema.layout.slice(TIP), schema.out_layout.slice(TIP)
    wrong = (schema.infer(x, frozenset({command}))[:, out] - x[:, span]) * schema.scaler.std[span]
    return 1e3 * float(np.linalg.norm(wrong, axis=1).mean())


def run(robot: RobotConfig, schema: BodySchema, way: UpdateConfig, runs: int, hide: set[str]) -> list[float]:
    """Median and worst samples to recognise, milliseconds per sample, mean error [mm] after every mark."""
    prior, command, conditions = Prior.of(schema), robot.command.signal, list(schema.biases)
    needed, spent, errors = [], [], []
    for index in range(runs):
        random = np.random.default_rng(100 + index)
        before, after = random.choice(conditions, 2, replace=False)
        lived, fresh = postures(robot, after, AFTER[-1], random, 0.08), postures(robot, after, 200, random)
        updater = Updater(schema.under(before), way)
        right, curve = [], []
        for count in range(1, len(lived[command]) + 1):
            updater.add({name: values[count - 1] for name, values in lived.items() if name not in hide})
            begun = time.perf_counter()
            p = updater.step().bias
            spent.append(time.perf_counter() - begun)
            right.append(after == min(conditions, key=lambda c: prior.between(p, schema.biases[c])))
            if count in AFTER:
                curve.append(tip_error(updater.schema, fresh, command))
        wrong = np.flatnonzero(~np.array(right))
        needed.append(1 if not len(wrong) else int(wrong[-1]) + 2)
        errors.append(curve)
    return [float(np.median(needed)), float(max(needed)), 1e3 * float(np.median(spent)), *np.mean(errors, axis=0)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", choices=("pr2_duster", "kxr_humanoid"))
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--hide", action="append", default=[])
    options = parser.parse_args()
    console = Console(width=140)
    robot = load_robot(robot_file(options.robot))
    schema = trained(robot)
    table = Table("way", "samples, median", "worst", "ms per sample", *(f"mm after {mark}" for mark in AFTER))
    for label, way in track(WAYS.items(), "ways", console=console):
        table.add_row(label, *(f"{value:.1f}" for value in run(robot, schema, way, options.runs, set(options.hide))))
    console.print(table)
    console.print(f"worst 36: not recognised within {AFTER[-1]} samples" if options.hide else "")
