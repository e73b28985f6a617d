"""Trials with the PR2's arm: the duster motion driven point by point, while a model follows the body."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.update import Updater
from gemuco.controller import Controller
from gemuco.estimation import estimate
from gemuco.schema import BodySchema
from gemuco.search.descent import DescentConfig
from gemuco.search.losses import Match, StayNear
from studies.paper.pr2.arm import JOINTS, TIP, Arm, Geometry

SEARCH = DescentConfig(gamma_max=0.5, candidates=20, iterations=60)
STAY = 0.3
"""Weight of ||theta - theta_orig|| (paper, III-A), both norms in standard deviations of the training data."""

Event = Callable[[Arm], None]


@dataclass(frozen=True, slots=True)
class Course:
    """What happened along a motion.

    Attributes:
        errors: Of the estimate or of the control at every point, before it was learned from [m], shape (n,).
        biases: p that was used there, shape (n, bias_size).
        schema: The model at the end.
    """

    errors: np.ndarray
    biases: np.ndarray
    schema: BodySchema

    def mean(self, first: int = 0, last: int | None = None) -> float:
        """Mean error [mm] from one point to before another; to the end if none is given."""
        return float(self.errors[first:last].mean() * 1e3)


def estimate_along(arm: Arm, schema: BodySchema, postures: np.ndarray, update: UpdateConfig) -> Course:
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
    return Course(np.array(errors), np.stack(biases), updater.schema)


def control_along(
    arm: Arm,
    schema: BodySchema,
    targets: np.ndarray,
    origins: np.ndarray,
    geometry: Geometry,
    update: UpdateConfig | None,
    events: Mapping[int, str] | None = None,
) -> Course:
    """Bring the tool tip to targets [m], (n, 3), near postures theta_orig [rad], (n, 7).

    Args:
        arm: What is moved.
        schema: The model to begin with.
        targets: Shape (n, 3).
        origins: Shape (n, 7).
        geometry: Whose limits hold.
        update: How to follow the body; None: not at all.
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
        found = controller.solve({TIP: target, JOINTS: origin}, {JOINTS: origin})
        measured = arm.go(found.command)
        errors.append(_distance(arm.tip(), target))
        biases.append(controller.schema.bias)
        if updater is not None:
            updater.add(measured)
            updater.step()
            controller.swap(updater.schema)
    return Course(np.array(errors), np.stack(biases), controller.schema)


def follow_blindly(arm: Arm, targets: np.ndarray, postures: np.ndarray) -> np.ndarray:
    """How far the tip is from targets [m], (n, 3), at postures [rad], (n, 7), that somebody else chose; (n,) [m]."""
    errors = []
    for target, posture in zip(targets, postures, strict=True):
        arm.go(posture)
        errors.append(_distance(arm.tip(), target))
    return np.array(errors)


def model_error(schema: BodySchema, rows: np.ndarray) -> float:
    """Mean error [m] of the tool tip inferred from the joints, on samples [unit], shape (k, size)."""
    x = schema.scaler.normalise(rows[np.isfinite(rows).all(axis=1)])
    amiss = (schema.infer(x, schema.masks[0]) - x[:, schema.out_index]) * schema.scaler.std[schema.out_index]
    return float(np.linalg.norm(amiss, axis=1).mean())


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one - other))
