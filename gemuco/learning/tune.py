"""Fine-tuning of a body schema on a few episodes of a similar body."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset
from gemuco.learning.accuracy import measure_errors
from gemuco.learning.blend import blended
from gemuco.learning.config import TrainConfig
from gemuco.learning.cross_fit import Errors, conditions_of, cross_fitted, folds_of, share
from gemuco.learning.draft import Draft
from gemuco.learning.history import History
from gemuco.learning.learner import Learner, Progress
from gemuco.learning.task import Task
from gemuco.learning.train import assessed, draft_key, history_of, judged_rows, material_of, schema_of
from gemuco.scaler import Scaler
from gemuco.schema import BodySchema


def fine_tune(
    schema: BodySchema,
    dataset: Dataset,
    config: TrainConfig,
    progress: Progress | None = None,
    title: str = "fine-tuning",
    resume: str | Path | None = None,
) -> tuple[BodySchema, History]:
    """Train a schema further on few samples of a similar body, such as a simulated and then the real robot.

    Training starts from the schema's W and from the p of every condition that the schema contains; the p of a new
    condition starts from the p in use. Scale, network shape and masks stay. The schema's anchors are replayed under
    their own p, which does not change: the schema does not forget postures that the new samples do not show.

    The expected errors of at most 2000 rows come from further trainings: each leaves out one part of the rows and
    predicts this part, so every row is judged by a model that did not learn from it. If the rows resemble each other so
    much that fewer than 15 are independent, the errors of the schema before count too.

    Args:
        schema: The schema to start from.
        dataset: Episodes of the present body, with the signals of the schema.
        config: Settings; `rate` is the peak, smaller than in training.
        progress: Called after every epoch.
        title: First words of the progress text.
        resume: As in `fit`.

    Returns:
        The schema with the p of all conditions, old and new, and errors and normal statistics of the new data, and the
        record of the training.

    Raises:
        DatasetError: A signal is missing, or has other elements or another unit.
        NotEnoughData: Too few samples to hold some out, or no sample that fits a mask.
    """
    dataset = dataset.with_layout(schema.layout)
    folds = folds_of(dataset, schema.scaler.std)
    conditions = dataset.conditions

    def trained(index: int, rows: Dataset) -> Learner:
        first = resume if index == 0 else None
        return _trained(schema, rows, conditions, config, share(progress, index, folds), title, first)

    learner = trained(0, dataset)
    train_data, _ = dataset.split(config.held_out, config.seed)
    history = history_of(learner, Scaler.fit(schema.layout, train_data.rows()), [])
    result = schema_of(learner, schema.scaler, conditions, schema)
    result = blended(result, *judged_rows(result, learner.held, conditions))
    result = assessed(result, learner, conditions)
    if folds is not None:
        result = cross_fitted(
            result,
            dataset,
            folds,
            lambda index, rows: schema_of(trained(1 + index, rows), schema.scaler, conditions, schema),
            lambda: _errors_before(schema, result, dataset),
            config.outliers,
        )
    return result, history


def _trained(
    schema: BodySchema,
    dataset: Dataset,
    conditions: tuple[str, ...],
    config: TrainConfig,
    progress: Progress | None,
    title: str,
    resume: str | Path | None = None,
) -> Learner:
    """Return the finished training from a schema; the data may lack some of the conditions."""
    task = Task(schema.layout, schema.masks, schema.x_out, schema.linear)
    train_data, held_data = dataset.split(config.held_out, config.seed)
    old = list(schema.biases.values()) if len(schema.bias) else [schema.bias]
    start = np.stack([*(schema.biases.get(c, schema.bias) for c in conditions), *old])
    frozen = np.arange(len(start)) >= len(conditions)
    material = material_of(task, schema.scaler, train_data, conditions, schema)
    held = material_of(task, schema.scaler, held_data, conditions)
    key = draft_key(config, task, dataset, *schema.weights.arrays(), start, schema.anchors, schema.scaler.std)
    learner = Learner(config, schema.weights, start, frozen, material, held)
    learner.run(progress, title, Draft(resume, key))
    return learner


def _errors_before(before: BodySchema, result: BodySchema, dataset: Dataset) -> Errors:
    """Return the errors of the schema before on all rows, with the p in use for conditions that it does not contain."""
    known = replace(before, biases={c: before.biases.get(c, before.bias) for c in result.biases})
    return measure_errors(known, dataset.rows(), conditions_of(result, dataset))
