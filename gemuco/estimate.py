"""State estimation (paper, II-G): what is missing, by a feasible mask, by descent on z, or by descent on x_in."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gemuco.compiled.inference import infer
from gemuco.descent import NewtonConfig
from gemuco.fold import fitting, input_lines, latent_lines
from gemuco.kernels import run
from gemuco.masks import Mask, covered_by
from gemuco.minimise import minimise

if TYPE_CHECKING:
    from gemuco.schema import BodySchema

SEARCH = NewtonConfig()
STARTS = 64
"""How many anchors of the training data a descent chooses its start from."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A signal as well as it can be known.

    Attributes:
        value: Measured values, with estimates in place of missing elements [unit], shape (n,); NaN if impossible.
        std: Expected error (1 sigma, from held-out data) [unit], shape (n,); 0 where measured, NaN where unknown.
        estimated: Which elements were estimated, shape (n,).
        method: `measured`, `mask` (usages a and b), `latent` (e), `input` (f) or `none`.
        mask: The signals it was estimated from; empty where measured.
        residual: How badly the model explains what it was given (root mean square, standard deviations of the
            training data), for `latent` also when what was found is given to the network again: a z beside the data's
            manifold fits what was measured, and yet its body does not exist. 0 where measured, NaN if impossible.
    """

    value: np.ndarray
    std: np.ndarray
    estimated: np.ndarray
    method: str
    mask: Mask
    residual: float


@dataclass(frozen=True, slots=True)
class _Guess:
    """A vector with every element filled in: values and std in units of the layout, shape (size,)."""

    value: np.ndarray
    std: np.ndarray
    method: str
    mask: Mask
    residual: float

    def where(self, missing: np.ndarray, joined: np.ndarray) -> "_Guess":
        """With what was measured in place of what was guessed."""
        value, std = np.where(missing, self.value, joined), np.where(missing, self.std, 0.0)
        return _Guess(value, std, self.method, self.mask, self.residual)


def estimate(schema: "BodySchema", values: Mapping[str, np.ndarray]) -> dict[str, Estimate]:
    """Every signal of the layout; see `BodySchema.estimate`."""
    joined = schema.layout.join_one(values)
    finite = np.isfinite(joined)
    whole = schema.layout.whole(finite)
    missing = ~finite
    measured = _Guess(joined, np.zeros(len(joined)), "measured", frozenset(), 0.0)
    guesses: dict[tuple[str, Mask], _Guess] = {}
    found: dict[str, Estimate] = {}
    for name, span in schema.layout.slices.items():
        guess, gone = measured, missing
        if name not in whole:
            way = _route(schema, name, whole, finite)
            if way not in guesses:
                guesses[way] = _guess(schema, *way, joined).where(missing, joined)
            guess = guesses[way]
            if guess.method == "none":
                gone = np.zeros(len(joined), bool)
        found[name] = Estimate(guess.value[span], guess.std[span], gone[span], guess.method, guess.mask, guess.residual)
    return found


def mask_error(schema: "BodySchema", mask: Mask, name: str) -> float:
    """Mean squared held-out error of a signal under a mask [standard deviations]; 1 where it was never measured."""
    known = schema.errors.get(("mask", mask))
    if known is None:
        return 1.0
    scaled = known / schema.scaler.std[schema.out_index]
    return float(np.mean(scaled[schema.out_layout.slice(name)] ** 2))


def _route(schema: "BodySchema", name: str, whole: Mask, finite: np.ndarray) -> tuple[str, Mask]:
    """How to estimate a signal, and from which signals."""
    if name in schema.x_out:
        mask = next((m for m in schema.ranked(name) if m <= whole), None)
        if mask is not None:
            return "mask", mask
        return ("latent", whole & set(schema.x_out)) if finite[schema.out_index].any() else ("none", frozenset())
    if name in schema.x_in and finite[schema.out_index].any() and covered_by(schema.masks, whole | {name}):
        return "input", whole & {*schema.x_in, *schema.x_out}
    return "none", frozenset()


def _guess(schema: "BodySchema", method: str, mask: Mask, joined: np.ndarray) -> _Guess:
    if method == "mask":
        value, residual = infer(schema.ready.predictor, joined, *schema.gate(mask))
        return _Guess(value, _std(schema, method, mask), method, mask, residual)
    x = np.where(np.isfinite(joined), schema.scaler.normalise(joined), np.nan)
    full = np.full(schema.layout.size, np.nan)
    if method == "latent":
        full[schema.out_index] = latent_search(schema, x)
    elif method == "input":
        full = input_search(schema, x, mask)
    residual = _residual(x, full)
    if method == "latent":
        residual = max(residual, _residual(x, _again(schema, full)))
    return _Guess(schema.scaler.restore(full), _std(schema, method, mask), method, mask, residual)


def _std(schema: "BodySchema", method: str, mask: Mask) -> np.ndarray:
    """Expected error of every element of the layout [unit], shape (size,); NaN where it is not known."""
    std = np.full(schema.layout.size, np.nan)
    known = schema.errors.get((method, mask))
    if known is not None:
        std[schema.out_index if len(known) == len(schema.out_index) else slice(None)] = known
    return std


def _residual(x: np.ndarray, full: np.ndarray) -> float:
    """Root mean square of what was given minus what the model says of it; NaN if it says nothing."""
    given = np.isfinite(x) & np.isfinite(full)
    return float(np.sqrt(np.mean((full[given] - x[given]) ** 2))) if given.any() else float("nan")


def _again(schema: "BodySchema", full: np.ndarray) -> np.ndarray:
    """What the network makes of a body it was given as found, by the first mask that can, shape (size,)."""
    again = full.copy()
    covered = covered_by(schema.masks, schema.layout.whole(np.isfinite(full)))
    if covered:
        again[schema.out_index] = schema.infer(full, covered[0])
    return again


def latent_search(schema: "BodySchema", x: np.ndarray) -> np.ndarray:
    """Usage (e): the x_out that fits the given ones best, shape (out_size,) [standard deviations].

    Args:
        schema: The body schema.
        x: Every signal [standard deviations], shape (size,), NaN where nothing was measured.
    """
    data = np.full(len(x), np.nan)
    data[schema.out_index] = x[schema.out_index]
    found = minimise(fitting(latent_lines(schema), data), schema.ready.latent_starts, SEARCH)
    return run(schema.weights.decoder, found.point)


def input_search(schema: "BodySchema", x: np.ndarray, available: Mask) -> np.ndarray:
    """Usage (f): missing x_in that make the network's output fit what is given, shape (size,) [standard deviations].

    Args:
        schema: The body schema.
        x: Every signal [standard deviations], shape (size,), NaN where nothing was measured.
        available: Signals of which every element was measured.

    Returns:
        x_out as predicted and the missing x_in as found; NaN elsewhere.
    """
    missing = set(schema.x_in) - set(schema.x_out) - available
    mask = max(covered_by(schema.masks, available | missing), key=lambda m: (len(m & missing), len(m)))
    full = np.where(np.isfinite(x), x, 0.0)
    base = schema.network_input(full, mask)
    through, _ = schema.gate(mask)
    sought = schema.layout.indices(mask - available)
    sought = sought[~np.isfinite(x[sought])]
    columns = np.flatnonzero(np.isin(schema.in_index, sought) & (through > 0))
    data = np.full(len(x), np.nan)
    data[schema.out_index] = x[schema.out_index]
    far = np.full(len(columns), np.inf)
    inferred = np.ones(len(schema.out_index), bool)
    anchors = schema.anchors[:STARTS]
    starts = anchors[:, sought] if len(anchors) else np.zeros((1, len(sought)))
    lines = input_lines(schema, base, columns, np.zeros(0, int), inferred, np.zeros(len(x)), -far, far)
    found = minimise(fitting(lines, data), starts, SEARCH).point
    result = np.full(schema.layout.size, np.nan)
    base[columns] = found
    result[schema.out_index] = run(schema.weights.whole, base)
    hidden = sought[~np.isin(sought, schema.out_index)]
    result[hidden] = found[np.isin(sought, hidden)]
    return result
