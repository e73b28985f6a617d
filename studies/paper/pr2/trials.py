"""Trials with the PR2's arm: the duster motion driven point by point, while a model follows the body."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.update import Updater
from gemuco.controller import Controller
from gemuco.estimation import estimate
from gemuco.schema import BodySchema
from gemuco.search.descent import DescentConfig
from gemuco.search.losses import Match, StayNear
from studies.paper.body import JOINTS
from studies.paper.pr2.arm import TIP, Arm, Geometry

SEARCH = DescentConfig(gamma_max=0.5, candidates=20, iterations=60)
STAY = 0.3
"""Weight of ||theta - theta_orig|| (paper, III-A), both norms in standard deviations of the training data."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Errors and p along a motion.

    Attributes:
        errors: Error of the estimate or of the control at every point, before it was learned from [m], shape (n,).
        biases: p at every point, shape (n, bias_size).
        schema: The model at the end.
    """

    errors: np.ndarray
    biases: np.ndarray
    schema: BodySchema

    def mean(self, first: int = 0, last: int | None = None) -> float:
        """Return the mean error [mm] from point `first` to before `last`; None: to the end."""
        return float(self.errors[first:last].mean() * 1e3)


def estimate_along(arm: Arm, schema: BodySchema, postures: np.ndarray, update: UpdateConfig) -> Trial:
    """Move through postures [rad], (n, 7), and estimate the tool tip from the joints alone while p is updated."""
    updater = Updater(schema, update)
    errors, biases = [], []
    for posture in postures:
        measured = arm.go(posture)
        now = updater.schema
        errors.append(_distance(estimate(now, {JOINTS: measured[JOINTS]})[TIP].value, arm.tip()))
        biases.append(now.bias)
        updater.add(measured)
        updater.step()
    return Trial(np.array(errors), np.stack(biases), updater.schema)


def control_along(
    arm: Arm,
    schema: BodySchema,
    targets: np.ndarray,
    origins: np.ndarray,
    geometry: Geometry,
    update: UpdateConfig | None,
    events: Mapping[int, str] | None = None,
) -> Trial:
    """Bring the tool tip to targets [m], (n, 3), near postures theta_orig [rad], (n, 7).

    Args:
        arm: The arm to move.
        schema: The first model.
        targets: Shape (n, 3).
        origins: Shape (n, 7).
        geometry: Has the joint limits.
        update: Settings of the online update; None: no update.
        events: Point -> duster that is put into the hand before it.
    """
    updater = None if update is None else Updater(schema, update)
    controller = Controller(
        schema,
        (Match(TIP), StayNear(JOINTS, STAY)),
        JOINTS,
        search=SEARCH,
        limits={JOINTS: (geometry.low, geometry.high)},
    )
    errors, biases = [], []
    for index, (target, origin) in enumerate(zip(targets, origins, strict=True)):
        if events and index in events:
            arm.hold(events[index])
        controller.restart()
        solution = controller.solve({TIP: target, JOINTS: origin}, {JOINTS: origin})
        measured = arm.go(solution.command)
        errors.append(_distance(arm.tip(), target))
        biases.append(controller.schema.bias)
        if updater is not None:
            updater.add(measured)
            updater.step()
            controller.swap(updater.schema)
    return Trial(np.array(errors), np.stack(biases), controller.schema)


def follow_blindly(arm: Arm, targets: np.ndarray, postures: np.ndarray) -> np.ndarray:
    """Return the distance [m], (n,), of the tip from targets [m], (n, 3), at given postures [rad], (n, 7)."""
    errors = []
    for target, posture in zip(targets, postures, strict=True):
        arm.go(posture)
        errors.append(_distance(arm.tip(), target))
    return np.array(errors)


def model_error(schema: BodySchema, rows: np.ndarray) -> float:
    """Return the mean error [m] of the tool tip inferred from the joints, on samples [unit], shape (k, size)."""
    x = schema.scaler.normalise(rows[np.isfinite(rows).all(axis=1)])
    residual = (schema.infer(x, schema.masks[0]) - x[:, schema.out_index]) * schema.scaler.std[schema.out_index]
    return float(np.linalg.norm(residual, axis=1).mean())


def _distance(tip: np.ndarray, target: np.ndarray) -> float:
    return float(np.linalg.norm(tip - target))
