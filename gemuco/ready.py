"""What a body schema is made into for compiled code, each when it is first asked for and then kept with the schema."""

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from gemuco.compiled.chain import pack
from gemuco.compiled.inference import Predictor
from gemuco.compiled.score import Judges
from gemuco.estimate import STARTS
from gemuco.kernels import run
from gemuco.scaler import CLIP

if TYPE_CHECKING:
    from gemuco.schema import BodySchema


class Ready:
    """A schema as compiled code takes it."""

    def __init__(self, schema: "BodySchema") -> None:
        self._schema = schema

    @cached_property
    def predictor(self) -> Predictor:
        """The network."""
        schema = self._schema
        scale = np.stack([schema.scaler.mean, schema.scaler.std])
        return Predictor(pack(schema.weights.whole), schema.in_index, schema.out_index, scale, CLIP)

    @cached_property
    def judges(self) -> Judges:
        """Which mask predicts what for the sake of anomaly detection."""
        schema = self._schema
        masks = list(dict.fromkeys(schema.judges.values()))
        through, tails = (np.stack(column) for column in zip(*(schema.gate(m) for m in masks), strict=True))
        order = [masks.index(schema.judges[s.name]) for s in schema.out_layout.signals for _ in range(s.size)]
        return Judges(through, tails, np.array(order))

    @cached_property
    def latent_starts(self) -> np.ndarray:
        """The z of some anchors, of which a descent on z chooses its start, shape (n, latent), n at least 1."""
        schema = self._schema
        if not len(schema.anchors):
            return np.zeros((1, schema.weights.decoder[0].matrix.shape[0]), np.float32)
        return run(schema.weights.encoder, schema.network_input(schema.anchors[:STARTS], schema.masks[0]))
