"""Adaption to a list of samples: p and W follow them until the error on samples left out stops falling."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.folds import Folds
from gemuco.adaption.gradient import GradientSteps, mean_error
from gemuco.adaption.recognise import recognise
from gemuco.adaption.renewal import Renewal
from gemuco.adaption.seen import SeenErrors, mean_squares, sample_errors, with_squares
from gemuco.adaption.update import Updater
from gemuco.certainty import Certainty
from gemuco.errors import check_kind
from gemuco.schema import BodySchema, ErrorTable, check_schema
from gemuco.signals import check_samples

LIST = UpdateConfig(rate=1e-3)
"""These are the settings for a list: W moves faster than online, because left-out samples end its motion."""
JUDGE_EVERY = 40
"""The samples left out are judged after every series of this many gradient steps."""
LEAST = 2000
"""At most this many gradient steps are taken, or one for each sample if there are more samples."""
SLOW = 0.02
"""The steps end when the last quarter of them lowered the error by less than this share."""

WARM_UP = 8
"""The steps do not end before this number of judgements."""
FEWER = 10
"""The training data are replayed with their weight in the settings and with this part of it, and the better is used:
a body without p that has changed contradicts them."""


@dataclass(frozen=True, slots=True)
class Trial:
    """A schema that learns from all samples but one part, and is judged by this part.

    Attributes:
        steps: The learner.
        schema: The schema now.
        others: Samples to learn from [standard deviations], shape (n, size).
        part: Samples left out, shape (n, size).
    """

    steps: GradientSteps
    schema: BodySchema
    others: np.ndarray
    part: np.ndarray

    def after(self, count: int, weights: bool, bias: bool) -> "Trial":
        """Return the trial after gradient steps; its schema has infinite numbers if they led there."""
        self.steps.take(count, self.schema, self.others, weights, bias)
        if not self.steps.is_finite:
            return self
        return replace(self, schema=self.steps.result(self.schema, weights, bias))

    @property
    def error(self) -> float:
        """Mean squared error of the part [standard deviations squared]; infinite after a step out of the numbers."""
        return mean_error(self.schema, self.part) if self.steps.is_finite else float("inf")


def adapt(
    schema: BodySchema, samples: Iterable[Mapping[str, np.ndarray]], config: UpdateConfig | None = None
) -> BodySchema:
    """Return the schema adapted to samples of the body; `Updater` takes them singly, as they come.

    p is recognised from all samples. Then W learns from them until the error on samples left out stops falling: up to
    five parts of the list are left out in turn, and the number of steps with the least error on them is taken with all
    samples. Neither p nor W moves if this does not lower the error on the samples left out.
    From fewer than four samples only p is recognised. The expected errors are those on the samples left out.

    Args:
        schema: The schema to begin with.
        samples: Signal -> value [its unit], shape (n,), oldest first.
        config: Settings of the update, `LIST` if not given. `minimum`, `steps`, `repeats` and `held_out` have no
            effect.

    Returns:
        The schema; `manifest["adaption"]` says what moved (`nothing`, `p`, `W` or `p and W`), with the number of
        samples and steps and the mean squared error on samples left out, before and after [standard deviations
        squared].
    """
    check_schema(schema)
    check_samples(samples)
    config = LIST if config is None else config
    check_kind("The settings of an update", config, UpdateConfig, "an UpdateConfig")
    updater = Updater(schema, replace(config, steps=0))
    for values in samples:
        updater.add(values)
    result, rows = updater.step(), updater.samples
    if not len(rows):
        return _recorded(schema, "nothing", 0, 0)
    folds = Folds.of(rows, [(0, np.arange(len(rows)))])
    if folds.count < 2:
        return _by_p_alone(schema, updater.schema, rows)
    is_gradual = config.bias_method == "gradient" or config.what == "both"
    weights = config.what in ("weights", "both") or (
        config.what == "bias_then_weights" and (result.settled or is_gradual)
    )
    bias = is_gradual and config.what != "weights" and len(schema.bias) > 0
    return _Choice(schema, updater.schema, rows, folds, config).made(weights, bias)


def _by_p_alone(schema: BodySchema, recognised: BodySchema, rows: np.ndarray) -> BodySchema:
    """Return the schema with the recognised p, or with its own if this predicts the samples as well."""
    is_better = mean_error(recognised, rows) < mean_error(schema, rows)
    chosen = schema.with_bias(recognised.bias) if is_better else schema
    errors = SeenErrors(schema)
    for row in rows.astype(float):
        errors.see(chosen, row)
    return _recorded(errors.renewed(chosen), "p" if is_better else "nothing", len(rows), 0)


@dataclass(frozen=True, slots=True)
class Course:
    """The best moment of the trials with one setting.

    Attributes:
        config: The setting.
        steps: Number of gradient steps until then.
        models: Schema of every trial.
        errors: Mean squared error of the part that each trial leaves out [standard deviations squared].
    """

    config: UpdateConfig
    steps: int
    models: list[BodySchema]
    errors: np.ndarray


class _Choice:
    """The choice between a schema, its recognised p, and further steps, by samples left out.

    Args:
        schema: The schema to begin with.
        recognised: The same with the p recognised from all samples.
        rows: Samples [standard deviations], shape (n, size).
        folds: Parts that are left out in turn.
        config: Settings of the update.
    """

    def __init__(
        self, schema: BodySchema, recognised: BodySchema, rows: np.ndarray, folds: Folds, config: UpdateConfig
    ) -> None:
        self._schema, self._recognised, self._rows = schema, recognised, rows
        self._folds, self._config = folds, config
        self._sizes = np.array([(folds.part == index).sum() for index in range(folds.count)])

    def made(self, weights: bool, bias: bool) -> BodySchema:
        """Return the schema of the least error.

        Args:
            weights: Whether W may move.
            bias: Whether p moves by gradient.
        """
        parts = [self._rows[self._folds.part == index] for index in range(self._folds.count)]
        before = np.array([mean_error(self._schema, part) for part in parts])
        models, errors, moved, chosen = [self._schema] * len(parts), before, "nothing", self._schema
        trials, steps = self._begun(self._config), 0
        with_p = np.array([trial.error for trial in trials])
        if self._mean(with_p) < self._mean(before):
            models, errors, moved, chosen = [trial.schema for trial in trials], with_p, "p", self._recognised
        if weights or bias:
            best = min((self._course(config, weights, bias) for config in self._replays()), key=self._of_course)
            gain = errors - best.errors
            final = self._final(best, weights, bias)
            if final is not None and self._mean(gain) > np.std(gain, ddof=1) / np.sqrt(len(gain)):
                models, errors, chosen, steps = best.models, best.errors, final, best.steps
                moved = " and ".join((["p"] if bias or self._has_p else []) + (["W"] if weights else []))
        chosen = chosen.with_weights(chosen.weights, self._expected(models, parts))
        chosen = chosen.with_certainty(self._certainty(models, parts))
        return _recorded(chosen, moved, len(self._rows), steps, self._mean(before), self._mean(errors))

    def _replays(self) -> list[UpdateConfig]:
        """Return the settings with the weights of the training data that are tried."""
        weights = {self._config.replay, self._config.replay // FEWER} if len(self._schema.anchors) else {0}
        return [replace(self._config, replay=weight) for weight in sorted(weights)]

    def _of_course(self, course: "Course") -> float:
        return self._mean(course.errors)

    @property
    def _has_p(self) -> bool:
        return not np.array_equal(self._schema.bias, self._recognised.bias)

    def _begun(self, config: UpdateConfig) -> list[Trial]:
        """Return a trial for every part that is left out, before the first step."""
        trials = []
        for index in range(self._folds.count):
            others, schema = self._rows[self._folds.part != index], self._schema
            if self._has_p:
                schema = schema.with_bias(recognise(schema, others, config.bias_method))
            steps = GradientSteps(schema, config, np.random.default_rng(config.seed))
            trials.append(Trial(steps, schema, others, self._rows[self._folds.part == index]))
        return trials

    def _course(self, config: UpdateConfig, weights: bool, bias: bool) -> "Course":
        """Let all trials learn until their mean error stops falling."""
        trials = self._begun(config)
        errors = np.array([trial.error for trial in trials])
        best = Course(config, 0, [trial.schema for trial in trials], errors)
        curve = [self._mean(errors)]
        while len(curve) * JUDGE_EVERY <= max(LEAST, len(self._rows)):
            trials = [trial.after(JUDGE_EVERY, weights, bias) for trial in trials]
            errors = np.array([trial.error for trial in trials])
            if self._mean(errors) < min(curve):
                best = Course(config, len(curve) * JUDGE_EVERY, [trial.schema for trial in trials], errors)
            curve.append(self._mean(errors))
            late = len(curve) - len(curve) // 4
            if len(curve) > WARM_UP and min(curve[late:]) > (1.0 - SLOW) * min(curve[:late]):
                break
        return best

    def _final(self, course: "Course", weights: bool, bias: bool) -> BodySchema | None:
        """Return the schema after the steps of a course with all samples; nothing if they led to infinite numbers."""
        learner = GradientSteps(self._recognised, course.config, np.random.default_rng(course.config.seed))
        learner.take(course.steps, self._recognised, self._rows, weights, bias)
        return learner.result(self._recognised, weights, bias) if learner.is_finite else None

    def _mean(self, errors: np.ndarray) -> float:
        """Return the mean over all samples of errors per part."""
        return float(errors @ self._sizes / self._sizes.sum())

    def _expected(self, models: Sequence[BodySchema], parts: Sequence[np.ndarray]) -> ErrorTable:
        """Return the table of expected errors, from the samples left out."""
        after = mean_squares([sample_errors(model, part) for model, part in zip(models, parts, strict=True)])
        before = mean_squares([sample_errors(self._schema, self._rows)])
        expected = {m: self._folds.expected(np.sqrt(after[m]), np.sqrt(before[m])) ** 2 for m in after}
        return with_squares(self._schema, expected)

    def _certainty(self, models: Sequence[BodySchema], parts: Sequence[np.ndarray]) -> Certainty | None:
        """Return the certainty renewed on the samples left out."""
        renewal, counts = Renewal(self._schema), dict.fromkeys(self._schema.masks, 0)
        for model, part in zip(models, parts, strict=True):
            for m, squared in sample_errors(model, part).items():
                covers = np.isfinite(part[:, model.layout.indices(m)]).all(axis=1)
                for row, errors in zip(part[covers].astype(float), squared, strict=True):
                    counts[m] += 1
                    renewal.see(model, row, m, errors, 1.0 / counts[m])
        return renewal.certainty()


def _recorded(
    schema: BodySchema, moved: str, samples: int, steps: int, before: float | None = None, after: float | None = None
) -> BodySchema:
    """Return the schema with the facts of its adaption in the manifest.

    The expected errors were measured with its p, so no error of p is added to them.
    """
    if samples and len(schema.bias):
        schema = schema.with_bias(schema.bias, np.zeros((len(schema.bias),) * 2))
    facts = {"moved": moved, "samples": samples, "steps": steps, "error_before": before, "error_after": after}
    return schema.with_manifest(adaption=facts)
