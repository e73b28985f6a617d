"""The actual-robot experiment on the PR2 (paper, III-A): another arm, the flexible duster, a model from simulation."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.update import Updater
from gemuco.dataset import Dataset, Episode
from gemuco.learning.tune import fine_tune
from gemuco.schema import BodySchema
from hal.config import RobotConfig
from services.hardware.stand_in import simulator_of
from services.learning.collector import Request, collect_direct
from services.learning.trainer import train_config
from services.model.model_config import collect_config, model_config
from services.show import Progress
from studies.paper.body import JOINTS
from studies.paper.pr2.arm import TIP, Arm, Geometry, duster_motion
from studies.paper.pr2.simulated import BELIEVED, ELEVATION, errors_by_grasp
from studies.paper.pr2.trials import Trial, control_along, follow_blindly, model_error
from studies.paper.runs import Run

ACTUAL = "actual"
COLLECTED, LEARNED = 0.35, 0.25
"""Shares of the robot file's samples that are collected and learned from per grasp: 350 and 250, 1500 in all."""
EPOCHS, RATE = 2 / 3, 3e-3
"""Epochs of fine-tuning, as a share of the robot file's, and its rate; no simulated duster is replayed."""
STIFF = "l700"
"""The stiff duster by which the geometry models the flexible one: about as long from hand to tip."""
BEGINS, HELD, CHANGED = "short_phi0", "long_phi60", "short_phi0"
"""Grasps in control: the first belief, the true one, and the one after the change."""
MODELS = ("geometry", "simulated", "fine-tuned")


@dataclass(frozen=True, slots=True)
class Actual:
    """One seed of the actual-robot experiment.

    Attributes:
        schema: Fine-tuned; its p of the flexible duster's grasps only.
        errors: Model -> grasp -> mean error [m] on samples that were not learned from, under the best p of each.
        controlled: Model -> error [m] at every point of two motions, between which the grasp changes.
        trial: Control with the fine-tuned model.
        change: Point before which the grasp changed.
        samples: Number of samples that were learned from.
    """

    schema: BodySchema
    errors: Mapping[str, Mapping[str, float]]
    controlled: Mapping[str, np.ndarray]
    trial: Trial
    change: int
    samples: int


def actual(run: Run, simulated: BodySchema, progress: Progress) -> Actual:
    """Collect on the actual arm, fine-tune the simulated model, and run every trial of one seed."""
    progress(0.0, "collecting on the actual arm")
    count = round(COLLECTED * collect_config(run.robot).samples)
    request = Request(flexible_grasps(run.robot), samples=count)
    data = run.cached("actual", lambda: collect_direct(run.robot, ACTUAL, run.seed, request).dataset, samples=count)
    learned, judged = split(data, LEARNED / COLLECTED)
    schema = run.cached(
        "actual_model", lambda: _tune(run, simulated, learned, progress), samples=len(learned), epochs=EPOCHS, rate=RATE
    )
    progress(0.6, "trials on the actual arm")
    geometry = Geometry(run.robot)
    controlled, trial, change = _control(run, geometry, simulated, schema)
    return Actual(
        schema=schema,
        errors=_errors(geometry, simulated, schema, learned, judged),
        controlled=controlled,
        trial=trial,
        change=change,
        samples=len(learned),
    )


def flexible_grasps(robot: RobotConfig) -> tuple[str, ...]:
    """Return the grasps of the flexible duster, which the simulator knows and the robot file does not list."""
    return tuple(name for name in simulator_of(robot).conditions if name.startswith(("short", "long")))


def split(data: Dataset, share: float) -> tuple[Dataset, Dataset]:
    """Split the episodes of every condition into the first `share` and the rest."""
    first: list[Episode] = []
    for condition in data.conditions:
        episodes = [episode for episode in data.episodes if episode.condition == condition]
        first += episodes[: round(share * len(episodes))]
    chosen = {id(episode) for episode in first}
    last = [episode for episode in data.episodes if id(episode) not in chosen]
    return Dataset(data.layout, tuple(first)), Dataset(data.layout, tuple(last))


def _tune(run: Run, simulated: BodySchema, learned: Dataset, progress: Progress) -> BodySchema:
    model = model_config(run.robot)
    config = replace(
        train_config(model, round(EPOCHS * (model.training.epochs or 300)), run.seed), rate=RATE, replay=0.0
    )
    schema, _ = fine_tune(simulated, learned, config, lambda done, text: progress(0.2 + 0.4 * done, text))
    return schema


def _errors(
    geometry: Geometry, simulated: BodySchema, tuned: BodySchema, learned: Dataset, judged: Dataset
) -> dict[str, dict[str, float]]:
    errors: dict[str, dict[str, float]] = {"geometry": {}, "simulated": {}}
    rows, owner = judged.rows(), judged.condition_of_rows()
    for index, condition in enumerate(judged.conditions):
        mine = rows[(owner == index) & np.isfinite(rows).all(axis=1)]
        away = (
            geometry.tips(_stiff(condition), mine[:, judged.layout.slice(JOINTS)]) - mine[:, judged.layout.slice(TIP)]
        )
        errors["geometry"][condition] = float(np.linalg.norm(away, axis=1).mean())
        errors["simulated"][condition] = model_error(_recognise(simulated, learned, condition), mine)
    return errors | {"fine-tuned": errors_by_grasp(tuned, judged)}


def _stiff(condition: str) -> str:
    return f"{STIFF}_{condition.split('_')[1]}"


def _recognise(schema: BodySchema, learned: Dataset, condition: str) -> BodySchema:
    """Return the schema under the p that explains the samples of a grasp best."""
    updater = Updater(schema, UpdateConfig(what="bias"))
    for episode in learned.episodes:
        if episode.condition == condition:
            for index in range(len(episode.values[JOINTS])):
                updater.add({name: values[index] for name, values in episode.values.items()})
    updater.step()
    return updater.schema


def _control(
    run: Run, geometry: Geometry, simulated: BodySchema, tuned: BodySchema
) -> tuple[dict[str, np.ndarray], Trial, int]:
    motion = duster_motion()
    change = len(motion)
    targets = np.concatenate([motion, motion])
    origins = np.tile(geometry.follow(motion, BELIEVED, ELEVATION), (2, 1))
    errors: dict[str, np.ndarray] = {}
    with Arm(run.robot, ACTUAL, run.seed, HELD) as arm:
        first, second = (geometry.follow(motion, _stiff(name), ELEVATION) for name in (HELD, CHANGED))
        before = follow_blindly(arm, motion, first)
        arm.hold(CHANGED)
        errors["geometry"] = np.concatenate([before, follow_blindly(arm, motion, second)])
    for name, schema in (("simulated", simulated.under(BELIEVED)), ("fine-tuned", tuned.under(BEGINS))):
        with Arm(run.robot, ACTUAL, run.seed, HELD) as arm:
            trial = control_along(arm, schema, targets, origins, geometry, UpdateConfig(), {change: CHANGED})
        errors[name] = trial.errors
    return errors, trial, change
