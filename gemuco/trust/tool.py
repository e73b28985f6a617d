"""The p that sensors are judged by: the model's own, once it is held against the sensors that may lie."""

import numpy as np

from gemuco.schema import BodySchema
from gemuco.trust.alternatives import is_another

EXPLAINS = 5.0
"""A tool or load explains all sensors if none was contradicted in this number of blocks of motion."""


class JudgedTool:
    """The model that sensors are judged by: newest W, and p of the tool or load that is believed to be in use.

    An online update that sees a lie may find the p of another tool that explains it for a posture or two.
    So that one is accepted only when it explains what contradicts the one so far.

    Attributes:
        schema: The model.
        proposed: The newest model, if its p is another number; else None.
        calm: Motion in which no sensor was contradicted [blocks at the usual pace].
    """

    def __init__(self, schema: BodySchema) -> None:
        """Begin with a model and its p."""
        self.schema = self._newest = schema
        self.proposed: BodySchema | None = None
        self._met, self._met_at, self._met_calm = schema.bias, 0.0, 0.0
        self.calm = 0.0

    def propose(self, schema: BodySchema) -> None:
        """Judge by the W of the newest model, and by its p once it is accepted."""
        if schema is self._newest:
            return
        self._newest = schema
        is_same = np.array_equal(schema.bias, self.schema.bias)
        self.proposed = None if is_same else schema
        self.schema = schema if is_same else schema.with_bias(self.schema.bias)

    def accept(self, moved: float) -> None:
        """Judge by the proposed p from now on; `moved` is the motion so far [blocks at the usual pace]."""
        self.schema, self.proposed = self._newest, None
        if is_another(self.schema, self.schema.bias, self._met[None])[0]:
            self._met, self._met_at, self._met_calm = self.schema.bias, moved, self.calm

    @property
    def has_explained(self) -> bool:
        """Whether this tool or load explained all sensors for a while; one that never did may be a wrong one.

        True without p: no tool can be wrong then.
        """
        return not len(self.schema.bias) or self.calm - self._met_calm >= EXPLAINS

    @property
    def is_another(self) -> bool:
        """Whether the proposed p is that of another tool or load than the one judged by."""
        other = self.proposed
        return other is not None and bool(is_another(other, other.bias, self.schema.bias[None])[0])

    def seen_for(self, moved: float) -> float:
        """Return the motion with this tool or load [blocks at the usual pace]."""
        return moved - self._met_at
