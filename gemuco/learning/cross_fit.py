"""Expected errors of few data: every row is judged by a model that did not learn from it."""

from collections.abc import Callable

import numpy as np

from gemuco.adaption.folds import FOLDS, Folds, chosen, series_of
from gemuco.dataset import Dataset
from gemuco.errors import NotEnoughData
from gemuco.learning import outliers
from gemuco.learning.accuracy import (
    ErrorRows,
    bias_of,
    error_rows,
    rms,
    scale_of,
)
from gemuco.learning.learner import Progress
from gemuco.learning.material import Material
from gemuco.learning.task import Task
from gemuco.linear import LinearPath
from gemuco.masks import Mask
from gemuco.schema import BodySchema

FEW = 2000
"""With at most this many rows the errors are measured by training once for every part of them."""

Errors = dict[tuple[str, Mask], np.ndarray]
"""See `gemuco.schema.ErrorTable`."""


def folds_of(dataset: Dataset, scale: np.ndarray) -> Folds | None:
    """Return the parts of a dataset that are left out in turn; nothing if it is too large or too small.

    Args:
        dataset: The data.
        scale: Standard deviation of every element [unit], shape (layout.size,).
    """
    if len(dataset) > FEW:
        return None
    folds = Folds.of(dataset.rows() / scale, series_of(dataset))
    return folds if folds.count > 1 else None


def share(progress: Progress | None, index: int, folds: Folds | None) -> Progress | None:
    """Return the progress of training number `index`: of the model itself (0), or of one of its judges."""
    count = 1 + (0 if folds is None else folds.count)
    return None if progress is None else lambda done, text: progress((index + done) / count, text)


def cross_fitted(
    result: BodySchema,
    dataset: Dataset,
    folds: Folds,
    train: Callable[[int, Dataset], BodySchema],
    before: Callable[[], Errors],
    limit: float,
) -> BodySchema:
    """Return a schema with expected errors from models that did not learn from the judged rows.

    Args:
        result: The schema that learned from all rows.
        dataset: The rows.
        folds: Their parts.
        train: Returns the schema that learned from other rows: (index of the part left out, rows) -> schema.
        before: Returns the errors without learning, which count too if few rows are independent.
        limit: Outliers are rejected beyond this; see `TrainConfig.outliers`.

    Returns:
        The schema; unchanged if no part could be left out.
    """
    errors: ErrorRows = {}
    for index in range(folds.count):
        part = folds.part == index
        try:
            judge = train(index, chosen(dataset, ~part))
        except NotEnoughData:
            continue  # without these rows a condition or a signal is missing; the other parts are measured
        if judge.x_out == result.x_out and (not judge.biases or set(dataset.conditions) <= set(judge.biases)):
            rows, owner = _without_outliers(judge, chosen(dataset, part), limit)
            for key, missed in error_rows(judge, rows, owner).items():
                scaled = missed * (scale_of(judge, key) / scale_of(result, key))
                errors[key] = np.concatenate([errors[key], scaled]) if key in errors else scaled
    if not errors:
        return result
    table = {key: rms(missed) * scale_of(result, key) for key, missed in errors.items()}
    first = before() if folds.doubt > 0.0 else table
    table = {key: folds.expected(error, first.get(key, error)) for key, error in table.items()}
    return result.with_weights(result.weights, table)


def doubted(schema: BodySchema, dataset: Dataset) -> BodySchema:
    """Return a schema with larger expected errors if fewer than 15 rows of its data are independent.

    Held-out rows of such data resemble the learned ones. Other rows are expected to be as far off as a linear path that
    was learned from a fifth of the data is on the rest of them, at most a standard deviation.
    """
    folds = Folds.of(dataset.rows() / schema.scaler.std, series_of(dataset))
    if folds.doubt == 0.0:
        return schema
    afar = _errors_afar(schema, dataset)
    errors = {
        key: folds.expected(error, scale_of(schema, key) * afar.get(key, 1.0)) for key, error in schema.errors.items()
    }
    return schema.with_weights(schema.weights, errors)


def _errors_afar(schema: BodySchema, dataset: Dataset) -> Errors:
    """Return the errors of linear paths, each learned from a part of the data, on the other parts, at most 1.

    Returns:
        (`mask`, mask) -> error of every element of x_out [standard deviations], shape (out_size,), not larger than with
        a part of the mask's signals. Empty if a part has too few complete samples.
    """
    rows = schema.scaler.normalise(dataset.rows())
    rows[:, schema.scaler.dead] = 0.0
    x, y = rows[:, schema.in_index], rows[:, schema.out_index]
    complete = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=1)
    x, y = x[complete], y[complete]
    squares: dict[tuple[str, Mask], list[np.ndarray]] = {("mask", mask): [] for mask in schema.masks}
    part = np.arange(len(x)) * FOLDS // max(1, len(x))
    for index in range(FOLDS):
        learned = part == index
        if learned.sum() < 2 * x.shape[1]:
            return {}
        path = LinearPath.fit(x[learned], y[learned], y.shape[1])
        for mask in schema.masks:
            through = schema.gate(mask).through
            line = path.direct(through, np.zeros(y.shape[1]))[:-1]
            missed = (x[~learned] * through) @ line[:-1] + line[-1] - y[~learned]
            squares["mask", mask].append((missed**2).mean(axis=0))
    errors = {mask: np.minimum(1.0, np.sqrt(np.mean(parts, axis=0))) for (_, mask), parts in squares.items()}
    within = {mask: [errors[part] for part in schema.masks if part <= mask] for mask in schema.masks}
    return {("mask", mask): np.min(parts, axis=0) for mask, parts in within.items()}


def _without_outliers(schema: BodySchema, dataset: Dataset, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rows [unit], NaN where a signal is an outlier, shape (n, layout.size), and their conditions, (n,)."""
    owner = conditions_of(schema, dataset)
    rows = dataset.rows()
    task = Task(schema.layout, schema.masks, schema.x_out, schema.linear)
    material = Material(task, schema.scaler.normalise(rows), owner, schema.scaler)
    suspects = outliers.find(material, schema.weights, bias_of(schema, owner), limit)
    return np.where(suspects[:, task.signal_of], np.nan, rows), owner


def conditions_of(schema: BodySchema, dataset: Dataset) -> np.ndarray:
    """Return the index into `schema.biases` of every row of a dataset, shape (rows,); 0 without parametric bias."""
    names = list(schema.biases)
    order = np.array([names.index(c) for c in dataset.conditions] if names else [0] * len(dataset.conditions), int)
    return order[dataset.condition_of_rows()]
