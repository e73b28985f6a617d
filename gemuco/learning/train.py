"""Training of a body schema from episodes (paper, II-D)."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from gemuco.dataset import Data, Dataset, as_dataset
from gemuco.errors import NotEnoughData, check_kind
from gemuco.layers import Weights
from gemuco.learning.accuracy import assess
from gemuco.learning.blend import blended
from gemuco.learning.config import TrainConfig
from gemuco.learning.cross_fit import doubted
from gemuco.learning.draft import Draft, key_of
from gemuco.learning.history import History
from gemuco.learning.learner import Learner, Progress
from gemuco.learning.material import Material
from gemuco.learning.network import first_weights, with_linear_path
from gemuco.learning.task import Task
from gemuco.linear import LinearPath
from gemuco.masks import Mask, label, mask
from gemuco.scaler import Scaler
from gemuco.schema import BodySchema

ANCHORS = 1000
"""A schema contains at most this many samples of its training data."""


def fit(
    data: Data,
    config: TrainConfig,
    masks: Iterable[Iterable[str]],
    progress: Progress | None = None,
    x_out: Iterable[str] | None = None,
    title: str = "training",
    resume: str | Path | None = None,
    units: Mapping[str, str] | None = None,
) -> tuple[BodySchema, History]:
    """Train a body schema.

    Args:
        data: Episodes of one body, as a dataset or as plain arrays; see `as_dataset`.
        config: Settings of the training.
        masks: The feasible masks; their union is x_in.
        progress: Called after every epoch.
        x_out: Signals to infer; every signal if not given.
        title: First words of the progress text.
        resume: A file in which the training is saved. If it contains the same training, interrupted, this is continued
            with the same result; if it contains the finished training, nothing is trained. The caller removes it.
        units: Signal -> unit, of plain arrays.

    Returns:
        The schema with its held-out errors and the statistics of its normal errors, and the record of the training.

    Raises:
        NotEnoughData: Too few samples to hold some out, or no sample that fits a mask.
        UnknownSignal: A mask or x_out names a signal that is not in the layout.
    """
    check_kind("The settings of a training", config, TrainConfig, "a TrainConfig")
    dataset = as_dataset(data, units)
    schema, learner, history = fit_weights(dataset, config, masks, progress, x_out, title, resume)
    conditions = dataset.conditions
    schema = blended(schema, *judged_rows(schema, learner.held, conditions))
    return doubted(assessed(schema, learner, conditions), dataset), history


def fit_weights(
    dataset: Dataset,
    config: TrainConfig,
    masks: Iterable[Iterable[str]],
    progress: Progress | None = None,
    x_out: Iterable[str] | None = None,
    title: str = "training",
    resume: str | Path | None = None,
) -> tuple[BodySchema, Learner, History]:
    """Train a body schema as `fit` does, without its errors and the statistics of its normal errors.

    Returns:
        The schema, its training with the samples, and the record of the training.
    """
    layout = dataset.layout
    checked = tuple(mask(m, layout.names) for m in masks)
    if not checked or frozenset() in checked:
        raise NotEnoughData("Training needs at least one mask, and no mask may be empty.")
    outputs = layout.subset(layout.names if x_out is None else tuple(x_out)).names
    train_data, held_data = dataset.split(config.held_out, config.seed)
    scaler = Scaler.fit(layout, train_data.rows())
    task, notes = _task(dataset, checked, outputs)
    notes.extend(dataset.repetitions())
    conditions = dataset.conditions
    task = _with_linear_path(task, scaler, train_data, config.latent_for(len(task.out_index)))
    material = material_of(task, scaler, train_data, conditions)
    held = material_of(task, scaler, held_data, conditions)
    frozen = np.full(len(conditions), len(conditions) == 1)
    bias_size = config.bias_for(len(conditions))
    notes += _bias_notes(config, conditions)
    size = len(task.in_index) + len(task.x_in) + bias_size
    latent = config.latent_for(len(task.out_index))
    weights = first_weights(config.seed, size, len(task.out_index), config.hidden, latent, config.activation)
    weights = with_linear_path(weights, task.path.outputs, len(task.in_index))
    unused = bias_size if frozen.all() else 0
    _mute(weights, task, scaler.dead, unused)
    biases = np.zeros((len(conditions), bias_size), np.float32)
    learner = Learner(config, weights, biases, frozen, material, held)
    learner.run(progress, title, Draft(resume, draft_key(config, task, dataset)))
    weights = learner.weights
    _mute(weights, task, scaler.dead, unused)
    schema = schema_of(learner, scaler, conditions).with_weights(weights)
    return schema, learner, history_of(learner, scaler, notes)


def _task(dataset: Dataset, masks: tuple[Mask, ...], x_out: tuple[str, ...]) -> tuple[Task, list[str]]:
    """Return the task without signals that were never measured, and a remark on each of these."""
    layout, measured = dataset.layout, np.isfinite(dataset.rows()).any(axis=0)
    silent = [name for name in layout.names if not measured[layout.slice(name)].any()]
    notes = [
        f"Signal '{name}' was never measured: nothing is inferred from it, and it is not inferred. Check its sensor, "
        "or leave it out of the model's signals."
        for name in silent
    ]
    usable = tuple(m for m in masks if not m & set(silent))
    outputs = tuple(name for name in x_out if name not in silent)
    if not usable or not outputs:
        raise NotEnoughData(f"Nothing can be learned: {', '.join(silent)} was never measured; check what was recorded.")
    return Task(layout, usable, outputs), notes


def _bias_notes(config: TrainConfig, conditions: tuple[str, ...]) -> list[str]:
    """Return a remark on the length of p, if it was not set or does not fit the conditions."""
    size, names = config.bias_for(len(conditions)), ", ".join(conditions)
    if len(conditions) == 1:
        return [
            f"All data are of one condition ('{names}'), so the parametric bias has nothing to distinguish: p "
            "stays 0 and has no effect. Collect other conditions, or set `bias: 0`."
        ] * bool(size)
    if config.bias_size is None:
        return [f"p has length {size}, because the data are of {len(conditions)} conditions ({names})."]
    if size:
        return []
    return [
        f"The {len(conditions)} conditions of the data ({names}) are not distinguished, because the length of p was "
        "set to 0: the model is of their mean."
    ]


def _with_linear_path(task: Task, scaler: Scaler, data: Dataset, latent: int) -> Task:
    """Return the task with a linear path.

    The path is learned from the samples with all inputs and outputs. With less than two of them per input there is no
    path: the code has length 0.
    """
    rows = scaler.normalise(data.rows())
    rows[:, scaler.dead] = 0.0
    complete = np.isfinite(rows[:, [*task.in_index, *task.out_index]]).all(axis=1)
    x, y = rows[np.ix_(complete, task.in_index)], rows[np.ix_(complete, task.out_index)]
    width = min(latent, y.shape[1])
    if len(x) < max(10, 2 * x.shape[1]):
        return task
    return replace(task, linear=LinearPath.fit(x, y, width))


def material_of(
    task: Task, scaler: Scaler, data: Dataset, conditions: tuple[str, ...], before: BodySchema | None = None
) -> Material:
    """Return the samples of a dataset, followed by the anchors of the previous schema.

    Raises:
        NotEnoughData: No sample of the dataset can be used.
    """
    rows = scaler.normalise(data.rows())
    order = np.array([conditions.index(c) for c in data.conditions], int)
    owner = order[data.condition_of_rows()]
    if before is None or not len(before.anchors):
        material = Material(task, rows, owner, scaler)
    else:
        old = before.anchor_conditions if len(before.anchor_conditions) else np.zeros(len(before.anchors), int)
        both = np.concatenate([rows, before.anchors.astype(float)])
        material = Material(task, both, np.concatenate([owner, len(conditions) + old]), scaler, len(rows))
    if material.skipped == material.new:
        names = ", ".join(label(m, task.layout.names) for m in task.masks)
        raise NotEnoughData(f"No sample has all signals of any mask ({names}); check what was recorded.")
    return material


def _mute(weights: Weights, task: Task, dead: np.ndarray, unused: int) -> None:
    """Set the weights of dead elements and of an unused p to zero; a dead output is then always its mean."""
    first, last = weights.encoder[0], weights.decoder[-1]
    first.matrix[np.flatnonzero(np.isin(task.in_index, dead))] = 0.0
    first.matrix[len(first.matrix) - unused :] = 0.0
    outputs = np.flatnonzero(np.isin(task.out_index, dead))
    last.matrix[:, outputs] = 0.0
    last.offset[outputs] = 0.0


def draft_key(config: TrainConfig, task: Task, dataset: Dataset, *arrays: np.ndarray) -> str:
    """Return the key of a training for its draft."""
    masks = [label(m, task.layout.names) for m in task.masks]
    return key_of(config, task.layout, masks, task.x_out, dataset.conditions, dataset.rows(), *arrays)


def schema_of(
    learner: Learner, scaler: Scaler, conditions: tuple[str, ...], before: BodySchema | None = None
) -> BodySchema:
    """Build the schema from the learned weights, without errors and normal statistics."""
    material, task = learner.material, learner.task
    learned = learner.biases[: len(conditions)].copy()
    known = {} if before is None else dict(before.biases)
    biases = {**known, **dict(zip(conditions, learned, strict=True))} if learned.shape[1] else {}
    rows = np.where(material.suspected[:, task.signal_of], np.nan, material.rows)[: material.new]
    complete = np.flatnonzero(np.isfinite(np.delete(rows, scaler.dead, axis=1)).all(axis=1))
    samples = complete[np.random.default_rng(learner.config.seed).permutation(len(complete))[:ANCHORS]]
    anchors, names = np.nan_to_num(rows[samples]), list(biases)
    owners = np.array([names.index(c) for c in conditions] if biases else [], int)
    owner = owners[material.condition[samples]] if biases else np.zeros(0, int)
    if before is not None and biases:  # anchors of conditions that the new data do not contain
        others = ~np.isin(before.anchor_conditions, owners)
        anchors = np.concatenate([anchors, before.anchors[others]])
        owner = np.concatenate([owner, before.anchor_conditions[others]])
    return BodySchema(
        layout=task.layout,
        x_in=task.x_in,
        x_out=task.x_out,
        masks=task.masks,
        scaler=scaler,
        weights=learner.weights,
        linear=task.linear,
        anchors=anchors.astype(np.float32),
        anchor_conditions=owner,
        bias=learned.mean(axis=0),
        biases=biases,
    )


def assessed(schema: BodySchema, learner: Learner, conditions: tuple[str, ...]) -> BodySchema:
    """Return the schema with errors and normal statistics of the held-out data without its outliers."""
    held, learned = (judged_rows(schema, part, conditions) for part in (learner.held, learner.material))
    return assess(schema, *held, training=learned)


def judged_rows(schema: BodySchema, part: Material, conditions: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the new samples without outliers [unit], shape (n, size), and their index into `schema.biases`, (n,)."""
    names = list(schema.biases)
    owners = np.array([names.index(c) for c in conditions] if names else [0] * len(conditions), int)
    rows = np.where(part.suspected[:, part.task.signal_of], np.nan, part.rows)[: part.new]
    return schema.scaler.restore(rows), owners[part.condition[: part.new]]


def history_of(learner: Learner, scaler: Scaler, notes: list[str]) -> History:
    """Return the record of a finished training."""
    course, material = learner.course, learner.material
    dead = tuple(material.task.layout.element(int(index)) for index in scaler.dead)
    return History(
        train=tuple(course.train),
        held_out=tuple(course.held_out),
        best=course.least,
        best_epoch=course.best_epoch,
        skipped=material.skipped,
        rejected=int(material.suspected[: material.new].sum()),
        dead=dead,
        notes=tuple(notes),
        resumed=course.resumed,
    )
