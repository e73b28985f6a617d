"""Ways to estimate missing elements, tried on normal samples in another thread than that of the ticks."""

from collections.abc import Callable
from functools import partial

import numpy as np

from gemuco.derived import ByPattern
from gemuco.estimation import Recipe, recipes
from gemuco.schema import BodySchema


class Ways:
    """The recipes of the schema in use.

    A trial takes as long as several ticks, and normal samples of another body say nothing of this one. So a tick uses a
    recipe that needs no trial until the better way is known. On a busy machine other sensors are late in every sample:
    only what lasts is tried, because trials would make it busier.

    Args:
        is_known: Whether the normal errors of a schema are known to be those of this body.
    """

    def __init__(self, is_known: Callable[[BodySchema], bool]) -> None:
        self._is_known = is_known
        self._tried: tuple[BodySchema, ByPattern[Recipe]] | None = None
        self._wanted: tuple[BodySchema, np.ndarray] | None = None
        self._lasts = b""
        """These are the finite elements that the last tick before `prepare` lacked a recipe for."""

    def at_hand(self, schema: BodySchema, finite: np.ndarray) -> Recipe:
        """Return a recipe for samples with these finite elements, truth values, shape (size,), without a trial."""
        if not finite.all() and self._is_known(schema):
            tried = self._tried
            if tried is not None and tried[0] is schema and tried[1].is_ready(finite):
                return tried[1](finite)
            self._wanted = schema, finite
        return schema.derived(recipes)(finite)

    def best(self, schema: BodySchema, finite: np.ndarray) -> Recipe:
        """Return the recipe for samples with these finite elements, tried now if it has not been."""
        if finite.all() or not self._is_known(schema):
            return schema.derived(recipes)(finite)
        tried = self._tried
        if tried is None or tried[0] is not schema:
            tried = self._tried = schema, ByPattern(partial(Recipe.of, schema, is_tried=True))
        return tried[1](finite)

    def prepare(self) -> None:
        """Try the ways that the last tick lacked, if they lacked at the call before too."""
        wanted, self._wanted = self._wanted, None
        lasted, self._lasts = self._lasts, b"" if wanted is None else wanted[1].tobytes()
        if wanted is not None and self._lasts == lasted:
            self.best(*wanted)
