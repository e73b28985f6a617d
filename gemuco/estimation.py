"""Estimation of missing values (paper, II-G): by a feasible mask, by descent on z, or by descent on x_in.

A signal of which only some elements are missing may be estimated better from the others: by regression on all measured
elements. Which way is best is known after both were tried on normal samples.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from gemuco.compiled.inference import infer
from gemuco.derived import ByPattern
from gemuco.intervals.beyond import Line, line_of
from gemuco.intervals.regression import METHOD, Regression
from gemuco.intervals.sureness import KNOWN, SURE, UNKNOWN, Judge, Judgement, RangeJudge, Sureness, since_change
from gemuco.layers import run
from gemuco.masks import Mask, covered_by, label
from gemuco.schema import BodySchema, check_schema
from gemuco.search.descent import NewtonConfig, minimise
from gemuco.search.fold import fitting, input_lines, latent_lines
from gemuco.search.routes import STARTS, latent_starts

SEARCH = NewtonConfig()
BETTER = 0.8
"""Regression is used if its expected error is below this share of that of the other way."""
TRIED = 16
"""A search is tried on this many normal samples."""

_OF_NOTHING = Judgement(Sureness(UNKNOWN, "nothing that it could be estimated from was measured"), 1.0)


@dataclass(frozen=True, slots=True)
class Estimate:
    """Measured and estimated values of a signal in one sample; of several samples, with one row per sample.

    Attributes:
        value: Measured values, and estimates of missing elements [unit], shape (n,); NaN if there is no estimate.
        std: Expected error of this estimate [unit], shape (n,): 90 % of the errors of held-out data are within
            `gemuco.certainty.NINETY` std; 0 where measured, NaN where unknown.
        estimated: Whether each element is an estimate, shape (n,).
        method: `measured`, `mask` (usages a and b), `latent` (e), `input` (f), `regression` on all measured elements,
            or `none`.
        mask: The signals from which it was estimated; empty where measured.
        residual: Root mean square of the given values minus the model's [standard deviations of the training data];
            0 where measured, NaN without estimate. For `latent` the network also predicts the given values from the
            estimate, and the larger error counts, because a z outside the manifold of the data may fit values that no
            body has.
        state: `known`; `doubtful` if the sample or p is a little, `unknown` if it is far outside of what was learned:
            then neither the value nor its std can be relied on.
        reason: One sentence on the state; empty if it is `known`.
    """

    value: np.ndarray
    std: np.ndarray
    estimated: np.ndarray
    method: str | np.ndarray
    mask: Mask | np.ndarray
    residual: float | np.ndarray
    state: str | np.ndarray = KNOWN
    reason: str | np.ndarray = ""


@dataclass(frozen=True, slots=True)
class Recipe:
    """Steps that complete all samples with the same missing elements, and the results that need no values.

    Attributes:
        steps: Each step: method, mask, the elements to estimate as truth values, shape (size,), and their signals.
        judges: The judge of each step's std and state; None where nothing is estimated.
        lines: The outputs of each step that follow the linear path beyond what was learned; None without any.
        unseen: The state of an estimate that nothing else speaks against: `SURE` unless the body changed.
        std: Expected error of every element [unit], shape (size,), before a sample is known; see `Estimate`.
        estimated: Whether each element is estimated, shape (size,).
        method: Signal -> method.
        mask: Signal -> mask.
        label: Signal -> mask as text.
    """

    steps: tuple[tuple[str, Mask, np.ndarray, tuple[str, ...]], ...]
    judges: tuple[Judge | RangeJudge | Regression | None, ...]
    lines: tuple[Line | None, ...]
    unseen: Sureness
    std: np.ndarray
    estimated: np.ndarray
    method: Mapping[str, str]
    mask: Mapping[str, Mask]
    label: Mapping[str, str]

    @classmethod
    def of(cls, schema: BodySchema, finite: np.ndarray, is_tried: bool = False) -> "Recipe":
        """Make the recipe for samples with these finite elements, truth values, shape (size,).

        Args:
            schema: The body schema.
            finite: Whether each element is finite, shape (size,).
            is_tried: Whether the ways to estimate the missing elements of a signal that is partly measured are tried.
        """
        slices, ways = schema.layout.slices, _ways(schema, finite, is_tried)
        std, estimated, steps, judges = np.zeros(len(finite)), np.zeros(len(finite), bool), [], []
        for way in dict.fromkeys(ways.values()):
            names, missing = tuple(name for name in slices if ways[name] is way), np.zeros(len(finite), bool)
            for name in names:
                missing[slices[name]] = ~finite[slices[name]]
            std[missing] = way.std[missing]
            estimated |= missing & (way.method != "none")
            if way.method != "measured":
                steps.append((way.method, way.given, missing, names))
                judges.append(way.regression or _judge(schema, way, finite))
        std.setflags(write=False)
        estimated.setflags(write=False)
        return cls(
            tuple(steps),
            tuple(judges),
            tuple(line_of(schema, mask) if method == "mask" else None for method, mask, _, _ in steps),
            since_change(schema, ~finite),
            std,
            estimated,
            {name: way.method for name, way in ways.items()},
            {name: way.given for name, way in ways.items()},
            {name: label(way.given, schema.layout.names) for name, way in ways.items()},
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """A way to estimate missing elements.

    Attributes:
        method: See `Estimate`.
        given: Signals that it is given.
        std: Expected errors [unit], shape (size,); NaN where unknown.
        is_tried: Whether they are those of a trial.
        regression: The estimates by regression.
    """

    method: str
    given: Mask
    std: np.ndarray
    is_tried: bool = False
    regression: Regression | None = None


def _ways(schema: BodySchema, finite: np.ndarray, is_tried: bool) -> dict[str, _Way]:
    """Return the way by which each signal is estimated; signals with the same way share it. See `Recipe.of`."""
    whole, known, ways = schema.layout.whole(finite), dict[tuple[str, Mask], _Way](), {}
    partly = [n for n, span in schema.layout.slices.items() if n not in whole and finite[span].any()]
    regression = Regression.of(schema, finite) if is_tried and partly else None
    other = None if regression is None else _Way(METHOD, regression.given, regression.std, regression=regression)
    for name, span in schema.layout.slices.items():
        method, mask = ("measured", Mask()) if name in whole else _route(schema, name, whole, finite)
        way = known.get((method, mask))
        if way is None:
            is_new = bool(is_tried and partly and method in ("latent", "input"))
            std = _tried(schema, method, mask, finite) if is_new else _std(schema, method, mask)
            way = known[method, mask] = _Way(method, mask, std, is_new)
        missing = span.start + np.flatnonzero(~finite[span])
        is_other = other is not None and name in partly and _is_better(other.std[missing], way.std[missing])
        ways[name] = other if other is not None and is_other else way
    return ways


def _is_better(std: np.ndarray, other: np.ndarray) -> bool:
    """Whether expected errors [unit] are clearly smaller than others, shape (n,), which may be unknown."""
    ratio = std / np.where(np.isfinite(other), other, np.inf)
    return bool(np.exp(np.mean(np.log(np.maximum(ratio, 1e-9)))) < BETTER)


def _tried(schema: BodySchema, method: str, mask: Mask, finite: np.ndarray) -> np.ndarray:
    """Return the root mean square errors of a search on normal samples [unit], shape (size,).

    They differ from the learned errors where it is given parts of signals. Without samples they are the learned ones.
    """
    size = schema.layout.size
    rows = np.zeros((0, size)) if schema.normal is None else schema.normal.rows.astype(float)
    if len(schema.bias) and len(rows):
        away = ((rows[:, size:] - schema.bias) ** 2).sum(axis=1)
        rows = rows[away <= away.min() + 1e-9]
    if not len(rows):
        return _std(schema, method, mask)
    rows = rows[np.linspace(0, len(rows) - 1, min(TRIED, len(rows))).astype(int), :size]
    squares = []
    for row in schema.scaler.restore(rows):
        prediction, _ = _search(schema, method, mask, np.where(finite, row, np.nan))
        squares.append((prediction - row) ** 2)
    return np.asarray(np.sqrt(np.mean(squares, axis=0)))


class Completion(NamedTuple):
    """A completed sample in one array.

    Attributes:
        value: Every element [its unit], shape (size,).
        std: Expected error of every element [its unit], shape (size,).
        residual: Signal -> residual; see `Estimate`.
        sureness: Signal -> state and reason.
        recipe: The steps and methods.
    """

    value: np.ndarray
    std: np.ndarray
    residual: dict[str, float]
    sureness: dict[str, Sureness]
    recipe: Recipe


def recipes(schema: BodySchema) -> ByPattern[Recipe]:
    """Return the recipes of a schema by the finite elements of a sample, of which none was tried."""
    return ByPattern(partial(Recipe.of, schema))


def tried_recipes(schema: BodySchema) -> ByPattern[Recipe]:
    """Return the recipes of a schema by the finite elements of a sample; see `Recipe.of`."""
    return ByPattern(partial(Recipe.of, schema, is_tried=True))


def estimate(schema: BodySchema, values: Mapping[str, np.ndarray]) -> dict[str, Estimate]:
    """Return every signal, with estimates of all missing elements.

    Args:
        schema: The body schema.
        values: Signal -> array [its unit], shape (n,), or (samples, n) for several samples. NaN elements and absent
            signals are estimated.

    Raises:
        UnknownSignal: A name is not in the layout.
        WrongSize: An array does not have its signal's size.
    """
    check_schema(schema)
    joined = schema.layout.join(values)
    joined.setflags(write=False)
    if joined.ndim == 2:
        return _batch(schema, [fill(schema, row) for row in joined])
    value, std, residual, sureness, recipe = fill(schema, joined)
    return {
        name: Estimate(
            value[span], std[span], recipe.estimated[span],
            recipe.method[name], recipe.mask[name], residual[name], *sureness[name],
        )
        for name, span in schema.layout.slices.items()
    }  # fmt: skip


def _batch(schema: BodySchema, samples: list[Completion]) -> dict[str, Estimate]:
    """Return the estimates of several samples, each attribute with a row per sample."""
    size = schema.layout.size
    value = np.array([sample.value for sample in samples]).reshape(-1, size)
    std = np.array([sample.std for sample in samples]).reshape(-1, size)
    estimated = np.array([sample.recipe.estimated for sample in samples], bool).reshape(-1, size)
    estimates = {}
    for name, span in schema.layout.slices.items():
        mask = np.empty(len(samples), object)
        mask[:] = [sample.recipe.mask[name] for sample in samples]
        method = np.array([sample.recipe.method[name] for sample in samples], object)
        residual = np.array([sample.residual[name] for sample in samples], float)
        state, reason = (np.array([sample.sureness[name][k] for sample in samples], object) for k in range(2))
        estimates[name] = Estimate(
            value[:, span], std[:, span], estimated[:, span], method, mask, residual, state, reason
        )
    return estimates


def fill(schema: BodySchema, joined: np.ndarray, recipe: Recipe | None = None) -> Completion:
    """Complete a sample in one array [unit of each element], shape (size,), NaN where missing; see `estimate`.

    The array must be read-only, as in a service: the code is compiled for read-only arrays. The recipe is that of its
    finite elements; the schema's, tried on normal samples, if not given.
    """
    recipe = recipe or schema.derived(tried_recipes)(np.isfinite(joined))
    value, residual, std = joined.copy(), dict.fromkeys(recipe.method, 0.0), recipe.std
    sureness = dict.fromkeys(recipe.method, SURE)
    if recipe.steps:
        std = std.copy()
    for (method, mask, missing, names), judge, line in zip(recipe.steps, recipe.judges, recipe.lines, strict=True):
        own = float("nan")
        if method == "mask":
            error, own = infer(*schema.parts, joined, *schema.gate(mask), missing, value)
        elif isinstance(judge, Regression):
            judge.predict(joined, missing, value)
            error = float("nan")
        else:
            prediction, error = _search(schema, method, mask, joined)
            np.copyto(value, prediction, where=missing)
        sure, inside = _OF_NOTHING if judge is None else judge.judge(joined, own, missing, std)
        if line is not None and inside < 1.0:
            line.take_over(joined, inside, missing, value)
        if sure is SURE:
            sure = recipe.unseen
        for name in names:
            residual[name], sureness[name] = error, sure
    return Completion(value, std, residual, sureness, recipe)


def _judge(schema: BodySchema, way: _Way, finite: np.ndarray) -> Judge | RangeJudge | None:
    if way.method == "none":
        return None
    if schema.certainty is None:
        return RangeJudge(schema, way.given, finite)
    return Judge(schema, (way.method, way.given), finite, way.std, TRIED if way.is_tried else 0)


def _route(schema: BodySchema, name: str, whole: Mask, finite: np.ndarray) -> tuple[str, Mask]:
    """Choose the method for a signal, and the signals from which it is estimated."""
    if name in schema.x_out:
        mask = next((m for m in schema.ranked(name) if m <= whole), None)
        if mask is not None:
            return "mask", mask
        return ("latent", whole & set(schema.x_out)) if finite[schema.out_index].any() else ("none", frozenset())
    if name in schema.x_in and finite[schema.out_index].any() and covered_by(schema.masks, whole | {name}):
        return "input", whole & {*schema.x_in, *schema.x_out}
    return "none", frozenset()


def _search(schema: BodySchema, method: str, mask: Mask, joined: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the predictions of a search [unit], shape (size,), NaN where there are none, and the residual."""
    x = np.where(np.isfinite(joined), schema.scaler.normalise(joined), np.nan)
    full = np.full(schema.layout.size, np.nan)
    if method == "latent":
        full[schema.out_index] = latent_search(schema, x)
    elif method == "input":
        full = input_search(schema, x, mask)
    residual = _residual(x, full)
    if method == "latent":
        residual = max(residual, _residual(x, _predict_again(schema, full)))
    return schema.scaler.restore(full), residual


def _std(schema: BodySchema, method: str, mask: Mask) -> np.ndarray:
    """Return the expected error of every element of the layout [unit], shape (size,); NaN where unknown."""
    std = np.full(schema.layout.size, np.nan)
    known = schema.errors.get((method, mask))
    if known is not None:
        std[schema.out_index if len(known) == len(schema.out_index) else slice(None)] = known
    return std


def _residual(x: np.ndarray, full: np.ndarray) -> float:
    """Return the root mean square of the given elements minus their predictions; NaN if there are none."""
    given = np.isfinite(x) & np.isfinite(full)
    return float(np.sqrt(np.mean((full[given] - x[given]) ** 2))) if given.any() else float("nan")


def _predict_again(schema: BodySchema, full: np.ndarray) -> np.ndarray:
    """Return an estimate with x_out predicted from the estimate itself, under the first covered mask, shape (size,)."""
    predicted = full.copy()
    covered = covered_by(schema.masks, schema.layout.whole(np.isfinite(full)))
    if covered:
        predicted[schema.out_index] = schema.infer(full, covered[0])
    return predicted


def latent_search(schema: BodySchema, x: np.ndarray) -> np.ndarray:
    """Return x_out for the z that fits the measured x_out best, usage (e), shape (out_size,) [standard deviations].

    Args:
        schema: The body schema.
        x: Every signal [standard deviations], shape (size,), NaN where nothing was measured.
    """
    data = np.full(len(x), np.nan)
    data[schema.out_index] = x[schema.out_index]
    solution = minimise(fitting(latent_lines(schema), data), schema.derived(latent_starts), SEARCH)
    return run(schema.weights.decoder, solution.point)


def input_search(schema: BodySchema, x: np.ndarray, available: Mask) -> np.ndarray:
    """Search the missing x_in for which the network's output fits the measured signals best, usage (f).

    Args:
        schema: The body schema.
        x: Every signal [standard deviations], shape (size,), NaN where nothing was measured.
        available: Signals of which every element was measured.

    Returns:
        The predicted x_out and the missing x_in, shape (size,) [standard deviations]; NaN elsewhere.
    """
    missing = set(schema.x_in) - set(schema.x_out) - available
    mask = max(covered_by(schema.masks, available | missing), key=lambda m: (len(m & missing), len(m)))
    full = np.where(np.isfinite(x), x, 0.0)
    base = schema.network_input(full, mask)
    through = schema.gate(mask).through
    free = schema.layout.indices(mask - available)
    free = free[~np.isfinite(x[free])]
    columns = np.flatnonzero(np.isin(schema.in_index, free) & (through > 0))
    data = np.full(len(x), np.nan)
    data[schema.out_index] = x[schema.out_index]
    far = np.full(len(columns), np.inf)
    inferred = np.ones(len(schema.out_index), bool)
    anchors = schema.anchors[:STARTS]
    starts = anchors[:, free] if len(anchors) else np.zeros((1, len(free)))
    lines = input_lines(schema, mask, base, columns, np.zeros(0, int), inferred, np.zeros(len(x)), -far, far)
    solution = minimise(fitting(lines, data), starts, SEARCH).point
    result = np.full(schema.layout.size, np.nan)
    base[columns] = solution
    result[schema.out_index] = run(schema.chain(mask), base)
    hidden = free[~np.isin(free, schema.out_index)]
    result[hidden] = solution[np.isin(free, hidden)]
    return result
