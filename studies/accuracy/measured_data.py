"""Structure and errors of the model on two recordings of real robots.

    python -m studies.accuracy.measured_data [--seeds 3]

The folder of the recordings is $GEMUCO_DATA, ../shared/data if that is not set. Settings are those of the descriptions
in examples/. The joint capsule: structure; then, trained on the first 80 % of the recording and tested on the rest as
one block, the error of the angles from all four boards and with each board lost, beside ridge regression that is fitted
anew for the boards that are left. The Schunk arm: structure; repetitions of a trajectory are held out together.
"""

import argparse
import os
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.learning.train import fit
from gemuco.schema import BodySchema
from gemuco.structure.determination import Thresholds, determine
from services.learning.trainer import train_config
from services.measured.description import MeasuredConfig, load_measured
from services.measured.reading import read_measured

ROOT = Path(__file__).parents[2]
BOARDS = tuple(f"board_{i}" for i in range(4))
ANGLES = "joint_position"


def recording(name: str) -> tuple[MeasuredConfig, Dataset]:
    """Return a description of examples/ and the data it describes."""
    config = load_measured(ROOT / "examples" / f"{name}.yaml")
    folder = Path(os.environ.get("GEMUCO_DATA", ROOT.parent / "shared" / "data"))
    return config, read_measured(config, folder / name)


def lost_boards(config: MeasuredConfig, data: Dataset, masks: tuple[frozenset[str], ...], seed: int) -> np.ndarray:
    """Return the errors of the angles with no board and with each board lost, last fifth held out [std], shape (5,)."""
    rows = data.rows()
    first = round(0.8 * len(rows))
    known = Dataset(data.layout, (Episode("known", data.layout.split(rows[:first])),))
    schema, _ = fit(known, train_config(config.model, config.training.epochs, seed), masks, x_out=(ANGLES,))
    return np.array([_error(schema, rows[first:], set(BOARDS) - {lost}) for lost in ("", *BOARDS)])


def _error(schema: BodySchema, rows: np.ndarray, given: set[str]) -> float:
    x = schema.scaler.normalise(rows)
    miss = schema.infer(x, frozenset(given)) - x[:, schema.out_index]
    return float(np.sqrt(np.mean(miss**2)))


def ridge(data: Dataset, weight: float = 10.0) -> np.ndarray:
    """Return the same errors of ridge regression, fitted for each set of boards, shape (5,)."""
    rows, layout = data.rows(), data.layout
    first = round(0.8 * len(rows))
    mean, std = rows[:first].mean(axis=0), rows[:first].std(axis=0)
    x = np.clip((rows - mean) / np.where(std > 0, std, np.inf), -4.0, 4.0)
    y = x[:, layout.slice(ANGLES)]
    errors = []
    for lost in ("", *BOARDS):
        given = x[:, layout.indices(set(BOARDS) - {lost})]
        normal = given[:first].T @ given[:first] + weight * np.eye(given.shape[1])
        prediction = given[first:] @ np.linalg.solve(normal, given[:first].T @ y[:first])
        errors.append(float(np.sqrt(np.mean((prediction - y[first:]) ** 2))))
    return np.array(errors)


def joint_capsule(seeds: range) -> None:
    """Print the structure and the errors with a board lost."""
    config, data = recording("joint_capsule")
    errors = []
    for seed in seeds:
        settings = config.structure
        thresholds = Thresholds(settings.threshold_out, settings.threshold_in, settings.measure, settings.over)
        structure = determine(data, train_config(config.model, settings.epochs, 100 * seed), thresholds)
        print(f"joint capsule, seed {seed}:\n{structure.report()}\n")
        errors.append(lost_boards(config, data, structure.masks, seed))
    mean, spread = np.mean(errors, axis=0), np.std(errors, axis=0)
    growth = np.array(errors)[:, 1:] / np.array(errors)[:, :1]
    print("error of the angles [std], last fifth held out: all boards, board 0 to 3 lost")
    print("    model", *(f"{m:.3f} ± {s:.3f}" for m, s in zip(mean, spread, strict=True)))
    print("    growth", *(f"{100 * (g - 1):+.0f} %" for g in mean[1:] / mean[0]), f"worst of a seed {growth.max():.2f}")
    print("    ridge", *(f"{e:.3f}" for e in ridge(data)))


def schunk_arm(seeds: range) -> None:
    """Print how well each signal is inferred from the others."""
    config, data = recording("schunk_arm")
    for seed in seeds:
        structure = determine(data, train_config(config.model, config.structure.epochs, 100 * seed))
        print(f"Schunk arm, seed {seed}:\n{structure.report()}\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    joint_capsule(range(options.seeds))
    schunk_arm(range(options.seeds))
