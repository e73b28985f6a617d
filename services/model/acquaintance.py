"""Whether the model's normal errors are those of the body in front of it.

A model that was trained on a designer's body, or that has just learned, has normal errors of another body. A score
above their threshold says that this body is another one, and not that a part of it is broken.
"""

from gemuco.layers import Weights
from gemuco.normal import Normal
from gemuco.schema import BodySchema

CALM_TIME = 2.0
"""The body is known after this time [s] in which it was as the model says."""
CALM_SAMPLES = 15
"""This time must contain at least this number of samples."""
ODD = 0.05
"""At most this share of them may be above the threshold."""


class Acquaintance:
    """The trial of a model's normal errors on the body: passed once, it holds until W or the normal errors change."""

    def __init__(self) -> None:
        self._known: tuple[Weights, Normal | None] | None = None
        self._tried: tuple[Weights, Normal | None] | None = None
        self._start, self._samples, self._odd = 0.0, 0, 0

    def is_known(self, schema: BodySchema) -> bool:
        """Whether the normal errors of a schema are known to be those of this body."""
        known = self._known
        return known is not None and known[0] is schema.weights and known[1] is schema.normal

    def learned(self, schema: BodySchema) -> None:
        """Take the normal errors of a schema as those of this body, because they were learned from it."""
        self._known = schema.weights, schema.normal

    def see(self, schema: BodySchema, is_odd: bool, now: float) -> None:
        """Count one sample of the trial.

        Args:
            schema: The model in use.
            is_odd: Whether the score of the sample is above the threshold.
            now: Monotonic time [s].
        """
        if schema.normal is None or self.is_known(schema):
            return
        if self._tried is None or self._tried[0] is not schema.weights or self._tried[1] is not schema.normal:
            self._tried, self._start, self._samples, self._odd = (schema.weights, schema.normal), now, 0, 0
        self._samples += 1
        self._odd += is_odd
        if now - self._start >= CALM_TIME and self._samples >= CALM_SAMPLES:
            if self._odd <= ODD * self._samples:
                self.learned(schema)
            self._tried = None
