"""The simulation experiment on the PR2 (paper, III-A): the nominal arm, the normal duster, nine grasps."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.dataset import Dataset
from gemuco.schema import BodySchema
from services.learning.collector import Request, collect_direct
from services.learning.trainer import train
from services.model.model_config import collect_config
from services.show import Progress
from studies.paper.pr2.arm import Arm, Geometry, duster_motion
from studies.paper.pr2.trials import Trial, control_along, estimate_along, model_error
from studies.paper.runs import Run, between

NOMINAL = "nominal"
BELIEVED = "l500_phi30"
"""The grasp of theta_orig, and the first belief in control."""
HELD = "l500_phi60"
"""The true grasp in control."""
ELEVATION, OTHER_ELEVATION = np.radians(45.0), np.radians(20.0)
"""Elevations of the stick [rad]: the constraints of theta_orig and of the other posture."""
POINTS = 20
"""Number of points after which the paper gives errors."""
FRESH, FRESH_SHARE = 1000, 0.1
"""Offset of the seed of the samples that judge models, and their share of those learned from."""

CASES = {
    "(1)": ("l500_phi60", "l500_phi0"),
    "(2)": ("l700_phi30", "l300_phi30"),
    "(3)": ("l500_phi60", "l400_phi15"),
    "(4)": ("l300_phi30", "l600_phi45"),
}
"""Cases of estimation: the first belief and the true grasp. (3) and (4) are ours: grasps between the trained ones."""
RECOGNISERS = {
    name: UpdateConfig(what="bias", bias_method=name, minimum=1) for name in ("ekf", "gauss_newton", "gradient")
}
KNOWN = "nothing, the grasp is known"
UPDATES: Mapping[str, UpdateConfig | None] = {
    "p, then W (default)": UpdateConfig(),
    "p": UpdateConfig(what="bias"),
    "p by gradient": RECOGNISERS["gradient"],
    "W": UpdateConfig(what="weights", optimiser="sgd", rate=0.01, replay=0, held_out=0, minimum=1, repeats=1),
    KNOWN: None,
}
"""Updates while another grasp is held. W alone is as in the paper: without replay, by gradient descent with momentum
(0.01). With the p of the true grasp from the start, the error is the trained model's own."""


@dataclass(frozen=True, slots=True)
class Order:
    """Order of p over the grasps.

    Attributes:
        length: R^2 of the linear regression of l on p, over the nine grasps.
        angle: R^2 of the linear regression of phi on p.
        spread: Length [mm] -> distance between the p of the largest and the smallest angle.
    """

    length: float
    angle: float
    spread: Mapping[int, float]


@dataclass(frozen=True, slots=True)
class Controlled:
    """Control under another grasp than the believed one.

    Attributes:
        trial: The motion during the update.
        elsewhere: The same targets at the other posture, the update stopped.
        others: Mean error [m] of the model under the p of the other grasps after the update.
    """

    trial: Trial
    elsewhere: Trial
    others: float


@dataclass(frozen=True, slots=True)
class Simulated:
    """One seed of the simulation experiment.

    Attributes:
        schema: As trained.
        held_out: Mean error [m] on fresh samples, under each grasp's own p.
        order: Order of p.
        estimated: (case, recogniser) -> errors.
        controlled: Update -> errors.
    """

    schema: BodySchema
    held_out: float
    order: Order
    estimated: Mapping[tuple[str, str], Trial]
    controlled: Mapping[str, Controlled]

    def fact(self, name: str) -> Any:
        """Return `L_i` or `L_m` of the training."""
        return self.schema.manifest[name]


def simulate(run: Run, progress: Progress) -> Simulated:
    """Collect, train, and run every trial of one seed."""
    robot, seed = run.robot, run.seed
    progress(0.0, "collecting")
    data = run.cached("nominal", lambda: collect_direct(robot, NOMINAL, seed).dataset)
    count = round(FRESH_SHARE * collect_config(robot).samples)
    fresh = run.cached(
        "nominal_fresh",
        lambda: collect_direct(robot, NOMINAL, seed + FRESH, Request(samples=count)).dataset,
        samples=count,
    )
    schema = run.cached(
        "nominal_model",
        lambda: train(robot, data, seed, between(progress, 0.3, 0.7)).schema,
    )
    progress(0.7, "trials")
    errors = errors_by_grasp(schema, fresh)
    return Simulated(
        schema=schema,
        held_out=float(np.mean(list(errors.values()))),
        order=order(schema),
        estimated=_estimations(run, schema),
        controlled=_controls(run, schema, fresh),
    )


def errors_by_grasp(schema: BodySchema, data: Dataset) -> dict[str, float]:
    """Return condition -> mean error [m] of the model under its p."""
    rows, owner = data.rows(), data.condition_of_rows()
    return {name: model_error(schema.under(name), rows[owner == index]) for index, name in enumerate(data.conditions)}


def order(schema: BodySchema) -> Order:
    """Regress l and phi of the nine grasps linearly on their p."""
    lengths, angles = np.array([[float(part) for part in _figures(name)] for name in schema.biases]).T
    p = np.stack(list(schema.biases.values())).astype(float)
    ends = {
        int(length): float(np.linalg.norm(np.subtract(*p[lengths == length][[0, -1]]))) for length in np.unique(lengths)
    }
    return Order(_explained(lengths, p), _explained(angles, p), ends)


def _figures(condition: str) -> tuple[str, str]:
    length, angle = condition.removeprefix("l").split("_phi")
    return length, angle


def _explained(values: np.ndarray, p: np.ndarray) -> float:
    columns = np.column_stack([p, np.ones(len(p))])
    left = values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]
    return float(1.0 - left @ left / np.sum((values - values.mean()) ** 2))


def _estimations(run: Run, schema: BodySchema) -> dict[tuple[str, str], Trial]:
    postures = Geometry(run.robot).follow(duster_motion(), BELIEVED, ELEVATION)
    trials = {}
    for case, (believed, held) in CASES.items():
        for name, update in RECOGNISERS.items():
            with Arm(run.robot, NOMINAL, run.seed, held) as arm:
                trials[case, name] = estimate_along(arm, schema.under(believed), postures, update)
    return trials


def _controls(run: Run, schema: BodySchema, fresh: Dataset) -> dict[str, Controlled]:
    geometry, targets = Geometry(run.robot), duster_motion()
    near, elsewhere = (geometry.follow(targets, BELIEVED, angle) for angle in (ELEVATION, OTHER_ELEVATION))
    results = {}
    for name, update in UPDATES.items():
        with Arm(run.robot, NOMINAL, run.seed, HELD) as arm:
            believed = schema.under(BELIEVED if update else HELD)
            trial = control_along(arm, believed, targets, near, geometry, update)
            again = control_along(arm, trial.schema, targets, elsewhere, geometry, None)
        errors = errors_by_grasp(trial.schema, fresh)
        results[name] = Controlled(trial, again, float(np.mean([e for c, e in errors.items() if c != HELD])))
    return results
