"""What a body schema is made into for compiled code, each when it is first asked for and then kept with the schema."""

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from gemuco.compiled.chain import pack
from gemuco.compiled.inference import Parts, Predictor
from gemuco.compiled.score import Judges
from gemuco.estimation import STARTS, Plan
from gemuco.layers import run
from gemuco.normal import Judgement
from gemuco.scaler import CLIP

if TYPE_CHECKING:
    from gemuco.schema import BodySchema

T = TypeVar("T")
PATTERNS = 64
"""Sets of missing elements for which plans are kept."""


class ByPattern(Generic[T]):
    """What is worked out of which elements of a sample are there, kept for at most `PATTERNS` of them.

    Threads that ask at the same moment may each work it out, and find the same.
    """

    def __init__(self, work_out: Callable[[np.ndarray], T]) -> None:
        self._work_out = work_out
        self._kept: dict[bytes, T] = {}
        self._last: bytes | None = None

    def __call__(self, finite: np.ndarray) -> T:
        """For these elements, truth values, shape (size,)."""
        key = self._last = finite.tobytes()
        found = self._kept.get(key)
        if found is None:
            found = self._work_out(finite)
            if len(self._kept) >= PATTERNS:
                self._kept.clear()
            self._kept[key] = found
        return found

    def follow(self, other: "ByPattern[T]") -> None:
        """Work out now what another one was asked for last."""
        if other._last is not None:
            self(np.frombuffer(other._last, bool))


class Ready:
    """A schema as compiled code takes it.

    Attributes:
        plan: How samples are filled in of which certain elements are there.
        judgement: How such samples are judged.
    """

    def __init__(self, schema: "BodySchema") -> None:
        self._schema = schema
        self.plan = ByPattern(lambda finite: Plan.of(schema, finite))
        self.judgement = ByPattern(lambda finite: Judgement.of(schema, finite))

    def __getstate__(self) -> "BodySchema":
        return self._schema

    def __setstate__(self, schema: "BodySchema") -> None:
        """Another process works everything out anew: arrays lose on their way that nobody may write into them."""
        Ready.__init__(self, schema)

    def prepare(self, other: "Ready") -> None:
        """Make now what the other one was asked for last, before a loop that keeps time asks this one."""
        _ = self.parts, self.judges
        self.plan.follow(other.plan)
        self.judgement.follow(other.judgement)

    @cached_property
    def predictor(self) -> Predictor:
        """The network."""
        schema = self._schema
        scale = np.stack([schema.scaler.mean, schema.scaler.std])
        return Predictor(pack(schema.weights.whole), schema.in_index, schema.out_index, scale, CLIP)

    @cached_property
    def parts(self) -> Parts:
        """The network as `gemuco.compiled.inference.infer` takes it."""
        return self.predictor.parts

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
