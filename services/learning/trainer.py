"""Training of a model for the service from recorded data: structure, training, and errors in physical units."""

import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from gemuco import checkpoint
from gemuco.dataset import Dataset
from gemuco.errors import CheckpointError, DatasetError, NotWritten
from gemuco.learning.config import TrainConfig
from gemuco.learning.history import History
from gemuco.schema import BodySchema
from gemuco.writing import writing
from hal.config import RobotConfig
from services.model.artifacts import fingerprint
from services.model.living_model import layout_of
from services.model.model_config import ModelConfig, model_config
from services.show import Progress

if TYPE_CHECKING:
    from gemuco.structure.determination import Structure

FINE_TUNING_RATE = 1.0 / 3.0
"""The peak learning rate of fine-tuning is this share of the rate in the robot file."""
LIKELY_SPLITS = 2
"""The progress assumes this many splits if their number is not given."""


@dataclass(frozen=True, slots=True)
class TrainingResult:
    """A model and facts about its training.

    Attributes:
        schema: The body schema, with the robot file's fingerprint in its manifest.
        structure: The determined structure; None after fine-tuning, which keeps the structure of the model.
        history: History of the training.
        samples: Number of samples.
        seconds: Time of structure determination and training [s].
    """

    schema: BodySchema
    structure: "Structure | None"
    history: History
    samples: int
    seconds: float


def train(
    robot: RobotConfig,
    dataset: Dataset,
    seed: int,
    progress: Progress,
    drafts: Path | None = None,
    base: BodySchema | None = None,
) -> TrainingResult:
    """Train the model of a robot by `learn`, or by `tune` from a model `base`.

    Raises:
        DatasetError: The data are of another robot, or in other units.
        NotEnoughData: The samples are too few, or no signal can be inferred.
    """
    try:
        own = dataset.with_layout(layout_of(robot))
    except DatasetError as error:
        raise DatasetError(
            f"The data do not fit '{robot.robot}': {error} Record data of this robot with `gemuco collect`."
        ) from None
    facts = {"robot": robot.robot, "fingerprint": fingerprint(robot)}
    if base is not None:
        return tune(base, model_config(robot), own, seed, progress, drafts, **facts)
    return learn(model_config(robot), own, seed, progress, drafts, **facts)


def learn(
    config: ModelConfig, dataset: Dataset, seed: int, progress: Progress, drafts: Path | None = None, **facts: str
) -> TrainingResult:
    """Determine the structure and train.

    Args:
        config: Settings of structure and training.
        dataset: Episodes of one body.
        seed: Seed of everything random.
        progress: Called with the share done, 0 to 1, and a line of text.
        drafts: Folder for unfinished trainings, from which an interrupted training continues; optional.
        facts: Facts for the model's manifest.

    Raises:
        NotEnoughData: The samples are too few, or no signal can be inferred.
    """
    from gemuco.learning.train import fit
    from gemuco.structure.determination import Thresholds, determine

    started, part = time.monotonic(), config.structure
    first = train_config(config, part.epochs, seed)
    last = train_config(config, config.training.epochs, seed)
    splits = part.splits or LIKELY_SPLITS
    share = part.epochs * splits / (part.epochs * splits + (last.epochs or part.epochs))
    thresholds = Thresholds(part.threshold_out, part.threshold_in, part.measure, part.over)
    structure = determine(
        dataset, first, thresholds, lambda done, text: progress(share * done, text), part.splits, drafts
    )
    schema, history = fit(
        dataset,
        last,
        structure.masks,
        lambda done, text: progress(share + (1.0 - share) * done, text),
        structure.x_out,
        resume=None if drafts is None else drafts / "training.safetensors",
    )
    schema = schema.with_manifest(
        **facts,
        samples=len(dataset),
        held_out_loss=history.best,
        **structure.facts,
    )
    return TrainingResult(schema, structure, history, len(dataset), time.monotonic() - started)


def tune(
    base: BodySchema,
    config: ModelConfig,
    dataset: Dataset,
    seed: int,
    progress: Progress,
    drafts: Path | None = None,
    **facts: str,
) -> TrainingResult:
    """Continue the training of a model on few samples of the real body; network and masks stay the same.

    Args:
        base: The first model, for example from simulation.
        config: Settings of training; the learning rate is a third of the rate there.
        dataset: Episodes of the real body.
        seed: Seed of everything random.
        progress: Called with the share done, 0 to 1, and a line of text.
        drafts: As for `learn`.
        facts: Facts for the model's manifest.

    Raises:
        DatasetError: The data lack a signal of the model, or are in other units.
        NotEnoughData: The samples are too few.
    """
    from gemuco.learning.tune import fine_tune

    started = time.monotonic()
    settings = train_config(config, config.training.epochs, seed)
    settings = replace(settings, rate=FINE_TUNING_RATE * settings.rate)
    resume = None if drafts is None else drafts / "training.safetensors"
    schema, history = fine_tune(base, dataset, settings, progress, resume=resume)
    schema = schema.with_manifest(**facts, samples=len(dataset), held_out_loss=history.best)
    return TrainingResult(schema, None, history, len(dataset), time.monotonic() - started)


def fits(robot: RobotConfig, folder: Path) -> bool:
    """Whether the folder holds an undamaged model for this robot file."""
    try:
        return checkpoint.load(folder).manifest.get("fingerprint") == fingerprint(robot)
    except CheckpointError:
        return False


def save(trained: TrainingResult, folder: Path) -> None:
    """Write the model with pictures of its structure and training, and remove its drafts."""
    from services.learning.plots import plot_history, plot_structure

    checkpoint.save(trained.schema, folder)
    with writing("The pictures", folder):
        if trained.structure is not None:
            plot_structure(trained.structure, folder / "structure.png")
        plot_history(trained.history, f"{trained.samples} samples", folder / "training.png")
    shutil.rmtree(drafts_of(folder), ignore_errors=True)


def drafts_of(folder: Path) -> Path:
    """Return the folder of unfinished trainings of the model in a folder.

    Raises:
        NotWritten: The folder is a file; checked before the training, which may take long.
    """
    if folder.exists() and not folder.is_dir():
        raise NotWritten(f"'{folder}' is a file, but a model needs a folder. Name another folder.")
    return folder.with_name(folder.name + ".draft")


def show(trained: TrainingResult, console: Console) -> None:
    """Print the structure, and the error of each signal under each mask in the signal's unit."""
    if trained.structure is not None:
        console.print(trained.structure.report(console.width), highlight=False, markup=False)
    table = Table(title="Error on held-out data, by the signals of the estimate", title_justify="left")
    table.add_column("estimated from")
    table.add_column("signal")
    table.add_column("error (rms)", justify="right")
    table.add_column("% of std", justify="right")
    for mask, name, unit, rms, percent in trained.schema.error_rows():
        table.add_row(mask, name, f"{rms:.4g} {unit}", f"{percent:.0f}")
    console.print(table)
    what = "training" if trained.structure is None else "structure and training"
    console.print(f"{trained.samples} samples, {what} in {trained.seconds:.1f} s.")
    known = () if trained.structure is None else trained.structure.remarks
    for sentence in remarks(trained.history):
        if sentence not in known:
            console.print(sentence, style="yellow", highlight=False)
    poor = trained.schema.manifest.get("poor")
    if poor:
        console.print(f"POOR: {', '.join(poor)} is above the threshold; see above.", style="red", highlight=False)


def remarks(history: History) -> list[str]:
    """Return sentences on faults in the data and on the training."""
    sentences = list(history.notes)
    if 0 < history.resumed < len(history.train):
        sentences.append(f"An interrupted training continued at epoch {history.resumed + 1}.")
    if history.dead:
        sentences.append(
            f"Never varied or never measured: {', '.join(history.dead)}. Their values have no effect on the model. "
            "Check these sensors, or leave them out."
        )
    if history.skipped:
        sentences.append(f"{history.skipped} training samples were skipped: they lack a signal of every mask.")
    if history.rejected:
        sentences.append(
            f"{history.rejected} measured signals in the training data were rejected as outliers: the other signals "
            "of their samples contradict them. If there are many, look for a loose sensor."
        )
    return sentences


def has_p(robot: RobotConfig) -> bool:
    """Whether a model that is learned from the robot file's conditions has a parametric bias."""
    return train_config(model_config(robot), None, 0).bias_for(max(1, len(robot.conditions))) > 0


def train_config(config: ModelConfig, epochs: int | None, seed: int) -> TrainConfig:
    """Return the training settings of the robot file for a number of epochs; None if it follows the data."""
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
        patience=config.training.patience,
        outliers=config.training.outliers,
        seed=seed,
    )
