"""Trials with the humanoid: a tool recognised from samples, and targets reached while tools are changed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.update import Updater
from gemuco.schema import BodySchema
from gemuco.search.descent import DescentConfig
from hal.config import RobotConfig
from services.model.control_config import ControlConfig, controller_of
from studies.paper.kxr.robot import CENTER, TIP, Standing

SEARCH = DescentConfig(gamma_max=0.5, candidates=10, iterations=100)
"""Search settings; the service makes fewer iterations per tick and continues in the next."""
NEAR = 0.2
"""Distance of p from a tool's p, as a share of the first distance, below which the tool is recognised."""
SMOOTH = 5
"""Number of steps of the average that is drawn beside the raw errors, as in the paper."""

Sample = Mapping[str, np.ndarray]


@dataclass(frozen=True, slots=True)
class Trial:
    """Errors and p step by step while targets are given.

    Attributes:
        tips: Distance of the tool tip from its target [m], shape (n,).
        centers: Center of gravity [m], shape (n, 2).
        biases: p at every step, shape (n, bias_size).
    """

    tips: np.ndarray
    centers: np.ndarray
    biases: np.ndarray

    @property
    def off_center(self) -> np.ndarray:
        """Distance of the center of gravity from the middle of the feet [m], shape (n,)."""
        distance: np.ndarray = np.linalg.norm(self.centers, axis=1)
        return distance


def recognise(schema: BodySchema, samples: Sequence[Sample], given: Sequence[str], update: UpdateConfig) -> np.ndarray:
    """Update p by samples with only some signals; return p before the first and after each, (n + 1, bias_size)."""
    updater = Updater(schema, update)
    path = [schema.bias]
    for sample in samples:
        updater.add({name: sample[name] for name in given})
        path.append(updater.step().bias)
    return np.stack(path)


def samples_until(path: np.ndarray, schema: BodySchema, condition: str) -> float:
    """Return the samples after which a tool is recognised to the end; infinite if it is not."""
    names, known = list(schema.biases), np.stack(list(schema.biases.values()))
    right = schema.biases[condition]
    away = np.linalg.norm(path - right, axis=1)
    nearest = np.argmin(np.linalg.norm(path[:, None] - known[None], axis=2), axis=1)
    wrong = (nearest != names.index(condition)) | (away >= NEAR * away[0])
    return float("inf") if wrong[-1] else float(np.flatnonzero(wrong)[-1] + 1)


def follow(
    robot: RobotConfig,
    body: Standing,
    schema: BodySchema,
    control: ControlConfig,
    targets: np.ndarray,
    update: UpdateConfig | None = None,
    changes: Mapping[int, str] | None = None,
) -> Trial:
    """Bring the tool tip to targets [m], shape (n, 3), while p follows the body.

    Args:
        robot: The robot file's content.
        body: The robot to move.
        schema: The first model.
        control: Other terms of the control.
        targets: Targets of the tip.
        update: Settings of the online update; None: no update.
        changes: Step -> tool that is put into the hand before it.
    """
    updater = None if update is None else Updater(schema, update)
    controller = controller_of(schema, robot, control, SEARCH)
    tips, centers, biases = [], [], []
    for index, target in enumerate(targets):
        if changes and index in changes:
            body.hold(changes[index])
        measured = body.go(controller.solve({TIP: target}).command)
        tips.append(np.linalg.norm(body.truth(TIP) - target))
        centers.append(body.truth(CENTER))
        biases.append(controller.schema.bias)
        if updater is not None:
            updater.add(measured)
            updater.step()
            controller.swap(updater.schema)
    return Trial(np.array(tips), np.stack(centers), np.stack(biases))


def follow_blindly(body: Standing, targets: np.ndarray, commands: np.ndarray) -> Trial:
    """Apply given commands blindly [rad], shape (n, 4)."""
    tips, centers = [], []
    for target, command in zip(targets, commands, strict=True):
        body.go(command)
        tips.append(np.linalg.norm(body.truth(TIP) - target))
        centers.append(body.truth(CENTER))
    return Trial(np.array(tips), np.stack(centers), np.zeros((len(tips), 0)))


def steps_until(errors: np.ndarray, bar: float) -> float:
    """Return the steps after which the average of the last errors stays below a bar; infinite if it does not."""
    above = np.flatnonzero(smoothed(errors) >= bar)
    if not len(above):
        return 0.0
    return float("inf") if above[-1] == len(errors) - 1 else float(above[-1] + 1)


def smoothed(errors: np.ndarray) -> np.ndarray:
    """Return the average over the last steps, shape (n,)."""
    return np.array([errors[max(0, index - SMOOTH + 1) : index + 1].mean() for index in range(len(errors))])


def order(biases: Mapping[str, np.ndarray], values: Mapping[str, Sequence[float]]) -> float:
    """Return R^2 of a linear fit of p on properties of the conditions (condition -> values)."""
    p = np.stack([biases[name] for name in values]).astype(float)
    columns = np.column_stack([np.array(list(values.values()), float), np.ones(len(p))])
    residual = p - columns @ np.linalg.lstsq(columns, p, rcond=None)[0]
    return float(1.0 - np.sum(residual**2) / np.sum((p - p.mean(axis=0)) ** 2))
