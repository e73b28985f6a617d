"""`gemuco train`: train a model from recorded data, show its errors, save it."""

from collections.abc import Sequence
from pathlib import Path

import typer

from gemuco import checkpoint
from gemuco.dataset import Dataset
from gemuco.errors import DatasetError
from hal.config import RobotConfig, load_robot
from hal.errors import ConfigError
from services import show
from services.learning import trainer
from services.learning.interruption import key_of_training, marked
from services.learning.trainer import TrainingResult
from services.measured import description, reading
from services.measured.table_files import is_table
from services.model import artifacts
from services.model.model_config import model_config
from services.recording.dataset import is_recording, select


def run_training(
    file: Path, data: Sequence[Path], out: Path | None, base: Path | None, seed: int, condition: str | None = None
) -> None:
    """Train a model and save it.

    Args:
        file: A robot file, or a description of measured data.
        data: Collected samples, recordings, or the folder of the measured files; their usual place if empty.
        out: Folder for the model; runs/<robot>/model if not given.
        base: A model to fine-tune; None trains a new one.
        seed: Seed of all random numbers.
        condition: Condition of the body in recordings; if not given, as recorded.

    Raises:
        SchemaError: Data, model or settings do not fit.
        RecordingError: A recording cannot be read.
    """
    known = None if base is None else checkpoint.load(base)
    if is_table(file):
        raise ConfigError(f"'{file}' holds data. `gemuco describe {file}` drafts a description to train from.")
    if description.is_description(file):
        described = description.load_measured(file)
        name, dataset, settings = described.recording, _measured(described, _only(data) or file.parent), described.model
    else:
        robot = load_robot(file)
        name, dataset, settings = robot.robot, _data(robot, data, condition), model_config(robot)
    if known is not None and not len(known.bias) and len(dataset.conditions) > 1:
        typer.echo(
            f"The conditions of the data ({', '.join(dataset.conditions)}) are not distinguished: the model in {base} "
            "has no p. Train a new one without --from."
        )
    folder = out or artifacts.model_folder(name)
    drafts = trainer.drafts_of(folder)

    def train(progress: show.Progress) -> TrainingResult:
        if not description.is_description(file):
            return trainer.train(robot, dataset, seed, progress, drafts, known)
        if known is not None:
            return trainer.tune(known, described.model, dataset, seed, progress, drafts, recording=name)
        return trainer.learn(described.model, dataset, seed, progress, drafts, recording=name)

    try:
        with marked(drafts, key_of_training(dataset, settings, seed, base)) as was_interrupted:
            if was_interrupted:
                typer.echo(f"The training of {folder} was interrupted. It continues.")
            with show.progress("training") as progress:
                result = train(progress)
    except KeyboardInterrupt:
        typer.echo("Interrupted. The same command continues from here.", err=True)
        raise
    trainer.show(result, show.console())
    trainer.save(result, folder)
    typer.echo(f"Saved in {folder}, with plots of the training.")


def _measured(config: description.MeasuredConfig, place: Path) -> Dataset:
    """Return the data that a description names in a folder, or in one file in place of those it names."""
    if place.is_file():
        config, place = config.model_copy(update={"episodes": (place.name,)}), place.parent
    return reading.read_measured(config, place, typer.echo)


def _data(robot: RobotConfig, data: Sequence[Path], condition: str | None) -> Dataset:
    """Return the collected samples, or those of recordings."""
    if not any(is_recording(path) for path in data):
        if condition is not None:
            raise DatasetError("--condition is for recordings (.mcap) only; collected samples have their conditions.")
        return Dataset.load(_only(data) or artifacts.data_path(robot.robot))
    if not all(is_recording(path) for path in data):
        raise DatasetError("Train from recordings (.mcap) or from collected samples (.npz), not from both at once.")
    selection = select(robot, data, condition)
    typer.echo(selection.sentence())
    return selection.dataset


def _only(data: Sequence[Path]) -> Path | None:
    if len(data) > 1:
        raise DatasetError(f"Only recordings (.mcap) can be several files; {data[0]} and {data[1]} are not.")
    return data[0] if data else None
