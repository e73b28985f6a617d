"""The actual-robot experiments on the humanoid (paper, III-C): another robot, few samples, a model from simulation."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from gemuco.dataset import Dataset, Episode
from gemuco.learning.tune import fine_tune
from gemuco.schema import BodySchema
from hal.config import RobotConfig
from services.learning.trainer import train_config
from services.model.living_model import layout_of
from services.model.model_config import model_config
from services.show import Progress
from studies.paper.body import JOINTS
from studies.paper.kxr.robot import Standing, inverse, random_targets, safe_postures, stiff
from studies.paper.kxr.simulated import AFTER, FRESH, LEADS, TOOLS, UPDATES, control_of, leads, recognitions
from studies.paper.kxr.trials import Trial, follow, follow_blindly, samples_until
from studies.paper.runs import Run

ACTUAL = "actual"
TAUGHT_GRID = (5, 3, 2, 2)
"""Number of taught postures along shoulder pitch and yaw, elbow and ankle pitch; 60 in all."""
TAUGHT_MARGIN = 0.15
"""Distance of taught postures from the ends of a joint's range, as a share of it."""
RANDOM = 20
"""Number of random postures per tool in which the designer's robot is in balance and sees its tool."""
PER_EPISODE = 10
EPOCHS, RATE = 300, 1e-3
"""Epochs and rate of fine-tuning."""
TARGETS = 30
MODELS = ("geometric", "simulated", "fine-tuned")
FOLLOWING = "simulated, p updated"


@dataclass(frozen=True, slots=True)
class Actual:
    """One seed of the actual-robot experiments.

    Attributes:
        schema: Fine-tuned.
        samples: Number of samples of fine-tuning.
        leads: Label -> path of p to a tool with all sensors.
        needed: Tool -> samples until it is recognised by the default update.
        recognised: Case -> samples until long_middle is recognised by the default update, shape (runs,).
        controlled: Model -> trial with long_middle.
    """

    schema: BodySchema
    samples: int
    leads: Mapping[str, np.ndarray]
    needed: Mapping[str, float]
    recognised: Mapping[str, np.ndarray]
    controlled: Mapping[str, Trial]


def actual(run: Run, simulated: BodySchema, progress: Progress) -> Actual:
    """Collect on the actual robot, fine-tune the simulated model, and run every trial of one seed."""
    progress(0.0, "collecting on the actual robot")
    settings = {"grid": TAUGHT_GRID, "margin": TAUGHT_MARGIN, "random": RANDOM}
    data = run.cached("actual", lambda: _collect(run), **settings)
    schema = run.cached(
        "actual_model", lambda: _tune(run, simulated, data, progress), epochs=EPOCHS, rate=RATE, **settings
    )
    progress(0.8, "trials on the actual robot")
    paths = leads(run, schema, ACTUAL)
    needed = {tool: samples_until(paths[f"to {tool}, ekf"], schema, tool) for tool in LEADS}
    recognised = {case: samples for (case, _), samples in recognitions(run, schema, ACTUAL, ["ekf"])[0].items()}
    return Actual(schema, len(data), paths, needed, recognised, _controlled(run, simulated, schema))


def taught_postures(robot: RobotConfig) -> np.ndarray:
    """Return the grid of postures [rad], shape (60, 4), that a person would teach."""
    low, high = robot.bounds(JOINTS)
    shares = [np.linspace(TAUGHT_MARGIN, 1.0 - TAUGHT_MARGIN, count) for count in TAUGHT_GRID]
    return low + (high - low) * np.array(list(product(*shares)))


def _collect(run: Run) -> Dataset:
    """Collect one sample per posture; signals out of sight are missing."""
    robot, episodes = run.robot, []
    layout, random = layout_of(robot), np.random.default_rng([FRESH + run.seed, 200])
    for tool in TOOLS:
        body = Standing(robot, ACTUAL, run.seed, tool)
        postures = [*random.permutation(taught_postures(robot)), *safe_postures(robot, tool, RANDOM, random)]
        rows = np.stack([layout.join(body.go(posture)) for posture in postures])
        parts = np.split(rows, range(PER_EPISODE, len(rows), PER_EPISODE))
        episodes += [Episode(tool, layout.split(part)) for part in parts]
    return Dataset(layout, tuple(episodes))


def _tune(run: Run, simulated: BodySchema, data: Dataset, progress: Progress) -> BodySchema:
    config = replace(train_config(model_config(run.robot), EPOCHS, run.seed), rate=RATE, replay=0.0)
    return fine_tune(simulated, data, config, lambda done, text: progress(0.1 + 0.7 * done, text))[0]


def _controlled(run: Run, simulated: BodySchema, tuned: BodySchema) -> dict[str, Trial]:
    robot, control = run.robot, control_of(run)
    targets = random_targets(robot, AFTER, TARGETS, np.random.default_rng([FRESH + run.seed, 300]))

    def body() -> Standing:
        return Standing(robot, ACTUAL, run.seed, AFTER)

    return {
        "geometric": follow_blindly(body(), targets, inverse(robot, stiff(robot, AFTER), targets)),
        "simulated": follow(robot, body(), simulated.under(AFTER), control, targets),
        FOLLOWING: follow(robot, body(), simulated.under(AFTER), control, targets, UPDATES["ekf"]),
        "fine-tuned": follow(robot, body(), tuned.under(AFTER), control, targets),
    }
