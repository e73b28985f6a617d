"""Fine-tuning of a body schema on a few episodes of a similar body."""

from pathlib import Path

import numpy as np

from gemuco.dataset import Dataset
from gemuco.learning.config import TrainConfig
from gemuco.learning.draft import Draft
from gemuco.learning.history import History
from gemuco.learning.learner import Learner, Progress
from gemuco.learning.task import Task
from gemuco.learning.train import assessed, draft_key, history_of, material_of, schema_of
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
    task = Task(schema.layout, schema.masks, schema.x_out, schema.linear)
    train_data, held_data = dataset.split(config.held_out, config.seed)
    conditions = dataset.conditions
    old = list(schema.biases.values()) if len(schema.bias) else [schema.bias]
    start = np.stack([*(schema.biases.get(c, schema.bias) for c in conditions), *old])
    frozen = np.arange(len(start)) >= len(conditions)
    material = material_of(task, schema.scaler, train_data, conditions, schema)
    held = material_of(task, schema.scaler, held_data, conditions)
    key = draft_key(config, task, dataset, *schema.weights.arrays(), start, schema.anchors, schema.scaler.std)
    learner = Learner(config, schema.weights, start, frozen, material, held)
    learner.run(progress, title, Draft(resume, key))
    result = assessed(schema_of(learner, schema.scaler, conditions, schema), learner, conditions)
    return result, history_of(learner, Scaler.fit(schema.layout, train_data.rows()), [])
