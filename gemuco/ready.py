"""What a body schema is made into for compiled code, each when it is first asked for and then kept with the schema."""

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from gemuco.compiled.chain import pack
from gemuco.compiled.inference import Predictor
from gemuco.compiled.score import Judges
from gemuco.estimate import STARTS, Plan
from gemuco.kernels import run
from gemuco.normal import Judgement
from gemuco.scaler import CLIP

if TYPE_CHECKING:
    from gemuco.schema import BodySchema

PATTERNS = 64
"""Sets of missing elements for which plans are kept."""


def _keep(kept: dict[bytes, Any], key: bytes, value: Any) -> None:
    """Keep it; whoever asks in another thread at the same moment makes the same."""
    if len(kept) >= PATTERNS:
        kept.clear()
    kept[key] = value


class Ready:
    """A schema as compiled code takes it."""

    def __init__(self, schema: "BodySchema") -> None:
        self._schema = schema
        self._plans: dict[bytes, Plan] = {}
        self._judgements: dict[bytes, Judgement] = {}

    def prepare(self, other: "Ready") -> None:
        """Make now what the other one was asked for, before a loop that keeps time asks this one."""
        _ = self.predictor, self.judges
        for key in list(other._plans):
            self.plan(np.frombuffer(key, bool))
        for key in list(other._judgements):
            self.judgement(np.frombuffer(key, bool))

    def plan(self, finite: np.ndarray) -> Plan:
        """How samples are filled in of which these elements are there, truth values, shape (size,)."""
        key = finite.tobytes()
        found = self._plans.get(key)
        if found is None:
            found = Plan.of(self._schema, finite)
            _keep(self._plans, key, found)
        return found

    def judgement(self, finite: np.ndarray) -> Judgement:
        """How samples are judged of which these elements are there, truth values, shape (size,)."""
        key = finite.tobytes()
        found = self._judgements.get(key)
        if found is None:
            found = Judgement.of(self._schema, finite)
            _keep(self._judgements, key, found)
        return found

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
