"""The verdict of structure determination on several seeds.

    python -m studies.accuracy.structure_seeds [--sets capsule schunk kuka arm pr2_duster ...] [--seeds 10] [--splits 1]

Each seed trains other networks. Printed are mean and standard deviation of L_i over the seeds, and how many seeds agree
with the most frequent verdict: on the outputs; and on every mask, where a seed contradicts if it says feasible and the
others do not (or the reverse) and does not call the mask undecided. `--splits` fixes the number of splits instead of
holding out other data until the verdict is decided.

The recordings are in $GEMUCO_DATA, ../shared/data if that is not set. `capsule` and `schunk` have the settings of
examples/; `kuka` is two trajectories of a KUKA KR300, every second row; `arm` is 1500 samples of a simulated arm of two
joints that moves between random postures; robots are named as their files, with at most `--samples` per condition.
"""

import argparse
import os
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset, as_dataset
from gemuco.errors import NotEnoughData
from gemuco.learning.config import TrainConfig
from gemuco.masks import label
from gemuco.structure.determination import Structure, Thresholds, determine
from hal.config import load_robot
from services.hardware.stand_in import condition_of
from services.learning.collector import Request, collect_direct
from services.learning.trainer import train_config
from services.model import artifacts
from services.model.living_model import layout_of
from services.model.model_config import ModelConfig, model_config
from studies.accuracy.measured_data import recording

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("GEMUCO_DATA", ROOT.parent / "shared" / "data"))
APART = 101
"""Successive seeds of the study differ by this number: they have no training in common and begin with other splits."""
Case = tuple[Dataset, TrainConfig, Thresholds]


def described(name: str) -> Case:
    """Return a recording with the settings of its description."""
    config, data = recording(name)
    return data, *settings(config.model)


def settings(model: ModelConfig) -> tuple[TrainConfig, Thresholds]:
    """Return the settings of structure determination."""
    part = model.structure
    thresholds = Thresholds(part.threshold_out, part.threshold_in, part.measure, part.over)
    return train_config(model, part.epochs, 0), thresholds


def kuka() -> Case:
    """Return two trajectories of a KUKA KR300, every second row."""
    episodes = []
    for letter in "AB":
        arrays = np.load(DATA / "kuka_kr300" / f"trajectory_{letter}.npz")
        radian = np.pi / 180.0
        episodes.append(
            {
                "motor_position": arrays["act_pos_mot_deg"][::2] * radian,
                "joint_position": arrays["act_pos_se_deg"][::2, :3] * radian,
                "motor_velocity": arrays["act_vel_mot_deg_per_s"][::2] * radian,
                "joint_effort": arrays["act_torque_abs_nm"][::2],
            }
        )
    units = {"motor_position": "rad", "joint_position": "rad", "motor_velocity": "rad/s", "joint_effort": "N m"}
    return as_dataset(episodes, units), TrainConfig(epochs=60, batch=100, rate=3e-3), Thresholds()


def arm(rows: int = 1500) -> Case:
    """Return an arm of two joints, 20 Hz, that moves between random postures within 1.25 s each."""
    random, stroke = np.random.default_rng(0), 25
    goals = random.uniform([-1.0, 0.2], [1.0, 2.0], (rows // stroke + 1, 2))
    share = np.linspace(0.0, 1.0, stroke, endpoint=False)[:, None]
    path = 10 * share**3 - 15 * share**4 + 6 * share**5
    q = np.concatenate([one + (other - one) * path for one, other in pairwise(goals)])
    velocity = np.gradient(q, 0.05, axis=0)
    acceleration = np.gradient(velocity, 0.05, axis=0)
    gravity = np.stack([4.0 * np.sin(q[:, 0]) + 1.2 * np.sin(q.sum(axis=1)), 1.2 * np.sin(q.sum(axis=1))], axis=1)
    effort = gravity + [0.15, 0.05] * acceleration + [0.3, 0.1] * velocity
    elbow = 0.3 * np.stack([np.sin(q[:, 0]), -np.cos(q[:, 0])], axis=1)
    tip = elbow + 0.25 * np.stack([np.sin(q.sum(axis=1)), -np.cos(q.sum(axis=1))], axis=1)
    values = {"joint_position": q, "joint_velocity": velocity, "joint_effort": effort, "tool_tip_position": tip}
    noise = {"joint_position": 0.005, "joint_velocity": 0.05, "joint_effort": 0.1, "tool_tip_position": 0.003}
    measured = {name: part + noise[name] * random.normal(size=part.shape) for name, part in values.items()}
    units = {"joint_position": "rad", "joint_velocity": "rad/s", "joint_effort": "N m", "tool_tip_position": "m"}
    return as_dataset(measured, units), TrainConfig(), Thresholds()


def simulated(name: str, samples: int) -> Case:
    """Return data of a simulated robot and the settings of its file."""
    robot = load_robot(artifacts.robot_file(name))
    conditions = tuple(robot.conditions) if condition_of(robot, None) else ()
    data = collect_direct(robot, request=Request(conditions, samples)).dataset
    return data.with_layout(layout_of(robot)), *settings(model_config(robot))


def study(name: str, case: Case, seeds: int, splits: int | None) -> None:
    """Print the verdicts on one set."""
    data, config, thresholds = case
    results: list[Structure] = []
    verdicts: list[tuple[str, ...]] = []
    started = time.monotonic()
    for seed in range(seeds):
        own = replace(config, seed=APART * seed)
        try:
            results.append(determine(data, own, thresholds, splits=splits))
            poor = getattr(results[-1], "poor", ())
            verdicts.append(tuple(f"{n} (poor)" if n in poor else n for n in results[-1].x_out))
        except NotEnoughData as error:
            verdicts.append(("refused",))
            print(f"    seed {own.seed}: {error}")
    took = (time.monotonic() - started) / seeds
    best, count = Counter(verdicts).most_common(1)[0]
    used = Counter(getattr(result, "splits", splits) for result in results)
    print(f"{name}: outputs {', '.join(best)} on {count} of {seeds} seeds; {took:.0f} s per seed; splits {dict(used)}")
    for signal in data.layout.names:
        values = [result.L_i[signal] for result in results if signal in result.L_i]
        if values:
            spread = np.mean([getattr(result, "spread_i", {}).get(signal, np.nan) for result in results])
            print(
                f"    L_i {signal}: {np.mean(values):.4f}, over seeds +- {np.std(values):.4f}, stated +- {spread:.4f}"
            )
    agreeing = [result for result, verdict in zip(results, (v for v in verdicts if v != ("refused",)), strict=True)]
    masks(data, agreeing)


def masks(data: Dataset, results: list[Structure]) -> None:
    """Print on how many seeds each mask has its most frequent verdict, where that is not all of them."""
    common = set.intersection(*(set(result.L_m) for result in results)) if results else set()
    uneven = 0
    for mask in sorted(common, key=lambda m: results[0].L_m[m]):
        said = [result.L_m[mask] < result.thresholds.into for result in results]
        usual = Counter(said).most_common(1)[0][0]
        contrary = [r for r, s in zip(results, said, strict=True) if s != usual]
        if contrary:
            uneven += 1
            firm = sum(mask not in getattr(result, "open", ()) for result in contrary)
            errors = [result.L_m[mask] for result in results]
            print(
                f"    {label(mask, data.layout.names)}: L_m {np.mean(errors):.3f} +- {np.std(errors):.3f}, the other "
                f"verdict on {len(contrary)} of {len(results)} seeds, {firm} of them without calling it undecided"
            )
    print(f"    {len(common) - uneven} of {len(common)} masks have the same verdict on all seeds")


SETS: dict[str, Callable[[], Case]] = {
    "capsule": lambda: described("joint_capsule"),
    "schunk": lambda: described("schunk_arm"),
    "kuka": kuka,
    "arm": arm,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=[*SETS, "pr2_duster", "musashi_arm", "kxr_humanoid"])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--splits", type=int, default=None)
    parser.add_argument("--samples", type=int, default=500, help="of a simulated robot, per condition")
    parser.add_argument("--epochs", type=int, default=None, help="instead of those of the set")
    options = parser.parse_args()
    for chosen in options.sets:
        made = SETS[chosen]() if chosen in SETS else simulated(chosen, options.samples)
        if options.epochs:
            made = (made[0], replace(made[1], epochs=options.epochs, patience=options.epochs), made[2])
        study(chosen, made, options.seeds, options.splits)
