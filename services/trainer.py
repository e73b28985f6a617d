"""From recorded data to a model that can serve: structure, training, and what the errors mean in physical units."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from gemuco.dataset import Dataset
from gemuco.errors import CheckpointError, DatasetError
from gemuco.masks import label
from gemuco.schema import BodySchema
from hal.config import RobotConfig
from services.artifacts import fingerprint
from services.living_model import layout_of
from services.model_config import ModelConfig, model_config

if TYPE_CHECKING:
    from gemuco.train import TrainConfig

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Trained:
    """A model and how it came about.

    Attributes:
        schema: The body schema, with the robot file's fingerprint in its manifest.
        report: The L_i and L_m tables for people.
        samples: How many samples it was made from.
        seconds: How long structure and training took.
    """

    schema: BodySchema
    report: str
    samples: int
    seconds: float


def train(robot: RobotConfig, dataset: Dataset, seed: int, progress: Progress) -> Trained:
    """Determine the structure and train; `progress` is told the share done, 0 to 1, and a line of text.

    Raises:
        DatasetError: The data are of another robot.
        NotEnoughData: Too few samples, or nothing can be inferred.
    """
    from gemuco import structure
    from gemuco import train as training

    config = model_config(robot)
    if dataset.layout != layout_of(robot):
        raise DatasetError(
            f"The data are of another robot: their signals are {', '.join(dataset.layout.names)}, "
            f"those of '{robot.robot}' are {', '.join(layout_of(robot).names)}, or elements differ. "
            "Use `gemuco collect`."
        )
    started = time.monotonic()
    first = train_config(config, config.structure.epochs, seed)
    last = train_config(config, config.training.epochs, seed)
    share = first.epochs / (first.epochs + last.epochs)
    thresholds = structure.Thresholds(config.structure.threshold_out, config.structure.threshold_in)
    found = structure.determine(dataset, first, thresholds, lambda done, text: progress(share * done, text))
    schema, history = training.fit(
        dataset, last, found.masks, lambda done, text: progress(share + (1 - share) * done, text), x_out=found.x_out
    )
    names = dataset.layout.names
    schema = schema.with_manifest(
        robot=robot.robot,
        fingerprint=fingerprint(robot),
        samples=len(dataset),
        held_out_loss=history.held_out[history.best_epoch],
        L_i=found.L_i,
        L_m={label(mask, names): value for mask, value in found.L_m.items()},
    )
    return Trained(schema, found.report(), len(dataset), time.monotonic() - started)


def fits(robot: RobotConfig, folder: Path) -> bool:
    """Whether a sound model lies there that was made for this robot file."""
    try:
        return BodySchema.load(folder).manifest.get("fingerprint") == fingerprint(robot)
    except CheckpointError:
        return False


def show(trained: Trained, console: Console) -> None:
    """Print the structure, and the error of each signal under each mask in its own unit."""
    console.print(trained.report, highlight=False)
    table = Table(title="Error on held-out data, by what it is estimated from", title_justify="left")
    table.add_column("estimated from")
    table.add_column("signal")
    table.add_column("error (rms)", justify="right")
    for mask, name, unit, rms in trained.schema.error_rows():
        table.add_row(mask, name, f"{rms:.4g} {unit}")
    console.print(table)
    console.print(f"{trained.samples} samples, structure and training in {trained.seconds:.1f} s.")


def train_config(config: ModelConfig, epochs: int, seed: int) -> "TrainConfig":
    """The robot file's way to train, for so many epochs."""
    from gemuco.train import TrainConfig

    return TrainConfig(
        hidden=config.network.hidden,
        latent=config.network.latent,
        activation=config.network.activation,
        bias_size=config.network.bias,
        epochs=epochs,
        batch=config.training.batch,
        rate=config.training.rate,
        bias_rate=config.training.bias_rate,
        held_out=config.training.held_out,
        patience=config.training.patience or epochs,
        outliers=config.training.outliers,
        seed=seed,
    )
