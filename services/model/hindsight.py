"""Errors of the model on signals that are measured: they say how wide the intervals of lost signals must be."""

from collections.abc import Callable
from functools import partial

import numpy as np

from gemuco.adaption.recognise import Prior
from gemuco.adaption.update import ANOTHER, SPREAD
from gemuco.derived import ByPattern
from gemuco.estimation import Recipe, fill
from gemuco.intervals.widening import RecentErrors
from gemuco.schema import BodySchema
from hal.clock import Clock
from services.model.estimation import Freshness, in_order

APART = 0.1
"""Errors are looked at once in this time [s] at most, and only if the robot moved: errors at rest are all the same."""


class Hindsight:
    """The factors on the std of estimates, from predictions of measured signals by all others.

    One thread calls `look`; any thread may read `factor`.

    Args:
        freshness: Source of samples.
        schema: Returns the body schema in use.
        clock: Source of time.
    """

    def __init__(self, freshness: Freshness, schema: Callable[[], BodySchema], clock: Clock) -> None:
        self._freshness, self._schema, self._clock = freshness, schema, clock
        size = schema().layout.size
        self._errors = RecentErrors(size)
        self._last, self._looked_at = np.full(size, np.nan), -np.inf
        self._bias, self._expected = schema().bias, schema().errors
        self._recipes: tuple[BodySchema, ByPattern[Recipe]] | None = None

    @property
    def factor(self) -> np.ndarray:
        """Factor of every element of the layout, shape (size,); the same array until `look` sees another error."""
        return self._errors.factor

    def look(self) -> None:
        """Predict every measured output from the other signals, if the robot moved since the last time."""
        fresh, values = self._freshness.together()
        now, schema = self._clock.monotonic(), self._schema()
        if fresh is None or now - self._looked_at < 0.9 * APART:
            return
        joined = in_order(schema, values).flat
        moved = np.abs(joined - self._last) / schema.scaler.std
        if np.isfinite(moved).any() and not np.nanmax(moved) >= SPREAD:
            return
        self._last, self._looked_at = joined, now
        self._forget_another_model(schema)
        missed, std = np.full(len(joined), np.nan), np.full(len(joined), np.nan)
        for name in schema.x_out:
            self._predict(schema, joined, schema.layout.slice(name), missed, std)
        if np.isfinite(missed).any():
            self._errors.see(missed, std)

    def _predict(
        self, schema: BodySchema, joined: np.ndarray, span: slice, missed: np.ndarray, std: np.ndarray
    ) -> None:
        """Write error and std of one signal, predicted without its own values."""
        if not np.isfinite(joined[span]).any():
            return
        hidden = joined.copy()
        hidden[span] = np.nan
        hidden.setflags(write=False)
        recipe = self._recipes_of(schema)(np.isfinite(hidden))
        if any(method != "mask" and missing[span].any() for method, _, missing, _ in recipe.steps):
            return  # a search takes milliseconds
        completion = fill(schema, hidden, recipe)
        missed[span], std[span] = completion.value[span] - joined[span], completion.std[span]

    def _recipes_of(self, schema: BodySchema) -> ByPattern[Recipe]:
        kept = self._recipes
        if kept is None or kept[0] is not schema:
            kept = self._recipes = schema, ByPattern(partial(Recipe.of, schema))
        return kept[1]

    def _forget_another_model(self, schema: BodySchema) -> None:
        """Begin anew if p is that of another body, or if the update has measured the expected errors on this one."""
        is_other = len(schema.bias) and Prior.of(schema).between(self._bias, schema.bias.astype(float)) > ANOTHER
        if is_other or schema.errors is not self._expected:
            self._errors.forget()
            self._bias, self._expected = schema.bias, schema.errors
