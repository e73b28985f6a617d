"""`gemuco train`: from recorded data to a saved model, with what a person should know on the screen."""

from pathlib import Path

import typer
from rich.console import Console

from gemuco.dataset import Dataset
from gemuco.schema import BodySchema
from hal.config import load_robot
from services import artifacts, measured, trainer
from services.show import progress
from services.trainer import Progress, Trained


def run_training(file: Path, data: Path | None, out: Path | None, base: Path | None, seed: int) -> None:
    """Train a model and save it.

    Args:
        file: A robot file, or a description of measured data.
        data: Recorded samples, or the folder of the measured files; where they usually lie if not given.
        out: Where to save; runs/<robot>/model if not given.
        base: A model to fine-tune; learned from nothing if not given.
        seed: Of all that is random.

    Raises:
        SchemaError: Data, model or settings are not what is needed.
    """
    known = None if base is None else BodySchema.load(base)
    if measured.is_description(file):
        described = measured.load_measured(file)
        name, dataset = described.recording, measured.read(described, data or file.parent)
    else:
        robot = load_robot(file)
        name, dataset = robot.robot, Dataset.load(data or artifacts.data_path(robot.robot))
    folder = out or artifacts.model_folder(name)
    drafts = trainer.drafts_of(folder)

    def train(tell: Progress) -> Trained:
        if not measured.is_description(file):
            return trainer.train(robot, dataset, seed, tell, drafts, known)
        if known is not None:
            return trainer.tune(known, described.model, dataset, seed, tell, drafts, recording=name)
        return trainer.learn(described.model, dataset, seed, tell, drafts, recording=name)

    if drafts.exists():
        typer.echo(f"A training of {folder} was interrupted; it goes on if data and settings are the same.")
    try:
        with progress("training") as tell:
            trained = train(tell)
    except KeyboardInterrupt:
        typer.echo("Interrupted. The same command goes on from here.", err=True)
        raise
    trainer.show(trained, Console())
    trainer.save(trained, folder)
    typer.echo(f"Saved in {folder}, with pictures of how it came about.")
