"""Cost of outliers in the training data, and effect of fine-tuning on the older conditions, on the PR2's arm.

    python -m studies.accuracy.imperfect_data

1 % of all training values are shifted by ten standard deviations. The errors are those of the tool tip inferred from
the joints, on clean samples of another motion, with each grasp's own p. Fine-tuning uses 250 samples of each of the
flexible duster's six grasps, with and without replay of the old training's anchors. It is tested on 60 other samples.
"""

import math
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

from gemuco.dataset import Dataset, Episode
from gemuco.learning.train import fit
from gemuco.learning.tune import fine_tune
from gemuco.schema import BodySchema
from hal.config import load_robot
from services.learning.collector import Request, collect_direct
from services.learning.trainer import train_config
from services.model.artifacts import robot_file
from services.model.model_config import model_config
from studies.paper.pr2.actual import flexible_grasps, split
from studies.paper.pr2.arm import JOINTS
from studies.paper.pr2.simulated import errors_by_grasp

SHARE, FAR = 0.01, 10.0
TUNING = 1e-3
"""Peak learning rate of fine-tuning."""


def with_outliers(data: Dataset) -> Dataset:
    """Return the same episodes with outliers, each in a random direction."""
    random = np.random.default_rng(0)
    spread = np.nanstd(data.rows(), axis=0)
    episodes = []
    for episode in data.episodes:
        rows = data.layout.join(episode.values)
        hit = random.random(rows.shape) < SHARE
        rows = rows + hit * random.choice([-FAR, FAR], rows.shape) * spread
        episodes.append(Episode(episode.condition, data.layout.split(rows)))
    return Dataset(data.layout, tuple(episodes))


def error(schema: BodySchema, fresh: Dataset) -> float:
    """Return the mean error of the tool tip over all grasps [mm]."""
    return 1e3 * float(np.mean(list(errors_by_grasp(schema, fresh).values())))


def main() -> None:
    robot, console = load_robot(robot_file("pr2_duster")), Console()
    model = model_config(robot)
    config = train_config(model, model.training.epochs, 0)
    clean = collect_direct(robot, "nominal", 0).dataset
    fresh = collect_direct(robot, "nominal", 1000, Request(samples=100)).dataset
    dirty, masks = with_outliers(clean), [{JOINTS}]
    table = Table("training", "tool tip [mm]")
    known = None
    for name, data, outliers in (
        ("clean data", clean, config.outliers),
        ("clean data, plain square", clean, math.inf),
        ("outliers", dirty, config.outliers),
        ("outliers, plain square", dirty, math.inf),
    ):
        schema, _ = fit(data, replace(config, outliers=outliers), masks, x_out=["tool_tip_position"])
        known = known or schema
        table.add_row(name, f"{error(schema, fresh):.1f}")
    assert known is not None
    recorded = collect_direct(robot, "actual", 0, Request(conditions=flexible_grasps(robot), samples=310)).dataset
    few, judged = split(recorded, 250 / 310)
    for name, replay in (("with replay", config.replay), ("without replay", 0.0)):
        tuned, _ = fine_tune(known, few, replace(config, rate=TUNING, replay=replay))
        old = known.with_weights(tuned.weights)
        table.add_row(f"fine-tuned {name}: normal grasps", f"{error(old, fresh):.1f}")
        table.add_row(f"fine-tuned {name}: flexible grasps", f"{error(tuned, judged):.1f}")
    console.print(table)


if __name__ == "__main__":
    main()
