"""The body schema of the arm: learned from its design, then from the motion of an actual arm."""

from dataclasses import dataclass

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.update import Updater
from gemuco.dataset import Dataset, Episode
from gemuco.masks import all_masks, label
from gemuco.schema import BodySchema
from gemuco.structure.determination import Structure, Thresholds
from hal import registry
from hal.config import RobotConfig
from services.model.living_model import layout_of
from services.model.model_config import model_config
from studies.paper.musashi.motion import LENGTH, POSITION, RATE, TENSION, signals

SAMPLES = 10_000
"""Number of random states of the geometric model, as in the paper."""
EPISODE = 100
BLIND = frozenset({TENSION, LENGTH})
"""The mask when the encoders are hidden: the paper's 011."""
CONSTANTS = np.geomspace(1.0, 2000.0, 400)
"""Candidate time constants of an exponential fit [s]."""


def geometric_data(robot: RobotConfig, seed: int) -> Dataset:
    """Draw random states of the designer's model, in episodes of independent samples."""
    states = registry.load_object(robot.collect["states"])(robot, SAMPLES, seed)
    parts = np.split(np.arange(SAMPLES), range(EPISODE, SAMPLES, EPISODE))
    episodes = tuple(Episode("geometric", {name: rows[part] for name, rows in states.items()}) for part in parts)
    return Dataset(layout_of(robot), episodes)


def structure_of(robot: RobotConfig, schema: BodySchema) -> Structure:
    """Return the structure that a training determined, from the schema's manifest and the robot file."""
    names, wanted, L_m = schema.layout.names, model_config(robot).structure, schema.manifest["L_m"]
    return Structure(
        layout=schema.layout,
        x_in=schema.x_in,
        x_out=schema.x_out,
        masks=schema.masks,
        L_i=schema.manifest["L_i"],
        L_m={mask: L_m[label(mask, names)] for mask in all_masks(names) if label(mask, names) in L_m},
        thresholds=Thresholds(wanted.threshold_out, wanted.threshold_in, wanted.measure, wanted.over),
    )


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """Result of an online update.

    Attributes:
        schema: The model at the end.
        time: Time of every sample [s], shape (n,).
        errors: Error of the joint positions with all encoders hidden, just before each sample was learned from [rad],
            norm over the joints, shape (n,).
    """

    schema: BodySchema
    time: np.ndarray
    errors: np.ndarray


def learn(robot: RobotConfig, schema: BodySchema, lived: Dataset, seed: int) -> UpdateResult:
    """Run the robot file's online update over a recording."""
    config = model_config(robot).update
    updater = Updater(schema, UpdateConfig(**config.model_dump(exclude={"interval"}), seed=seed))
    errors = []
    for row in lived.rows()[:, : schema.layout.size]:
        errors.append(float(joint_errors(updater.schema, row[None])[0]))
        updater.add(schema.layout.split(row))
        updater.step()
    return UpdateResult(updater.schema, np.arange(1, len(errors) + 1) / RATE, np.array(errors))


def joint_errors(schema: BodySchema, rows: np.ndarray) -> np.ndarray:
    """Return ||theta_est - theta|| [rad], shape (n,), with the encoders hidden, of samples [unit], shape (n, size)."""
    rows = rows[:, : schema.layout.size]
    x = schema.scaler.normalise(rows)
    estimate = np.full(x.shape, np.nan)
    estimate[:, schema.out_index] = schema.infer(x, BLIND)
    position = schema.layout.slice(POSITION)
    return np.asarray(np.linalg.norm((schema.scaler.restore(estimate) - rows)[:, position], axis=1))


def recorded_errors(schema: BodySchema, recording: Dataset) -> np.ndarray:
    """Return the `joint_errors` of a whole recording."""
    return joint_errors(schema, recording.rows())


def arrays(recording: Dataset, schema: BodySchema) -> dict[str, np.ndarray]:
    """Return signal of the schema -> samples [unit], shape (count, n)."""
    return {name: values for name, values in signals(recording).items() if name in schema.layout.names}


@dataclass(frozen=True, slots=True)
class Decay:
    """The function floor + drop * exp(-t / constant).

    Attributes:
        floor: [rad]
        drop: [rad]
        constant: [s]
    """

    floor: float
    drop: float
    constant: float

    def at(self, time: np.ndarray | float) -> np.ndarray:
        """Return values [rad] at times [s]."""
        return np.asarray(self.floor + self.drop * np.exp(-np.asarray(time) / self.constant))


def decay(time: np.ndarray, errors: np.ndarray, has_floor: bool = True) -> Decay:
    """Fit an exponential to errors [rad] over time [s] by least squares; without floor it goes to zero."""
    fits: list[tuple[float, Decay]] = []
    for constant in CONSTANTS:
        columns = [np.exp(-time / constant), *([np.ones_like(time)] if has_floor else [])]
        matrix = np.stack(columns, axis=1)
        weights = np.linalg.lstsq(matrix, errors, rcond=None)[0]
        residual = float(np.sum((matrix @ weights - errors) ** 2))
        fits.append((residual, Decay(float(weights[1]) if has_floor else 0.0, float(weights[0]), float(constant))))
    return min(fits, key=lambda pair: pair[0])[1]
