"""The anomaly loop: how unlike normal the body is, and which element says so."""

import math
from collections.abc import Callable

import numpy as np

from gemuco.schema import BodySchema
from hal.clock import Clock
from services.estimation import Freshness
from services.messages import Anomaly


class AnomalyWatch:
    """Makes one `Anomaly` per tick; an anomaly is one only after it has lasted."""

    def __init__(
        self,
        freshness: Freshness,
        schema: Callable[[], BodySchema],
        after: float,
        publish: Callable[[Anomaly], None],
        clock: Clock,
    ) -> None:
        """`after` is how long [s] the score must stay above its threshold."""
        self._freshness, self._schema, self._after, self._publish, self._clock = (
            freshness,
            schema,
            after,
            publish,
            clock,
        )
        self._above_since = math.inf
        self.latest: Anomaly | None = None

    def tick(self) -> None:
        """Score the newest sample; NaN, and nobody is blamed, without a fresh one or without normal data."""
        fresh, values = self._freshness.take()
        found = self._schema().anomaly(values)
        now = self._clock.monotonic()
        self._above_since = min(self._above_since, now) if found.score > found.threshold else math.inf
        self.latest = Anomaly(
            stamp_ns=self._clock.now_ns(),
            cycle=-1 if fresh is None else fresh.sample.cycle,
            score=float(found.score),
            threshold=float(found.threshold),
            is_anomaly=now - self._above_since >= self._after,
            blamed=found.blamed,
            contribution={name: np.asarray(part, float) for name, part in found.contribution.items()},
        )
        self._publish(self.latest)
