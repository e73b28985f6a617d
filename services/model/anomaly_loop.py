"""The anomaly loop: how unlike normal the body is, whether its environment changed, and which element is wrong."""

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from gemuco.anomaly import AnomalyScore, score
from gemuco.schema import BodySchema
from gemuco.verdict import Verdict, judge
from hal.clock import Clock
from services.model.estimation import Freshness
from services.wire.messages import Anomaly

ODD = 10
"""Newest samples above the threshold that a verdict is made from."""
JUDGE_EVERY = 0.3
"""Time [s] between two verdicts; one costs as much as some hundred scores."""


class AnomalyWatch:
    """Makes one `Anomaly` per tick; an anomaly is one only after it has lasted.

    While scores are above the threshold the samples are kept, and a verdict is made from all of them now and then.
    """

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
        self._odd: deque[dict[str, np.ndarray]] = deque(maxlen=ODD)
        self._last_cycle = -1
        self._verdict: Verdict | None = None
        self._judged_at = -math.inf
        self.latest: Anomaly | None = None

    def tick(self) -> None:
        """Score the newest sample; NaN, and nobody is blamed, without a fresh one or without normal data."""
        fresh, values = self._freshness.take()
        found = score(self._schema(), values, blame=False)
        now = self._clock.monotonic()
        cycle = -1 if fresh is None else fresh.sample.cycle
        if found.score > found.threshold:
            self._above_since = min(self._above_since, now)
            if cycle != self._last_cycle or not self._odd:
                self._odd.append(values)
        else:
            self._above_since, self._verdict, self._judged_at = math.inf, None, -math.inf
            self._odd.clear()
        self._last_cycle = cycle
        has_lasted = now - self._above_since >= self._after
        if has_lasted and now - self._judged_at >= JUDGE_EVERY:
            self._verdict, self._judged_at = judge(self._schema(), self._odd), now
        self._tell(found, cycle, has_lasted)

    def summary(self) -> dict[str, Any]:
        """What the last tick found, without the parts of each signal; empty before the first."""
        latest = self.latest
        if latest is None:
            return {}
        return {name: getattr(latest, name) for name in ("score", "threshold", "is_anomaly", "verdict", "blamed")}

    def _tell(self, found: AnomalyScore, cycle: int, has_lasted: bool) -> None:
        verdict = self._verdict
        kind = "normal" if found.score <= found.threshold else "" if verdict is None else verdict.kind
        self.latest = Anomaly(
            stamp_ns=self._clock.now_ns(),
            cycle=cycle,
            score=float(found.score),
            threshold=float(found.threshold),
            is_anomaly=has_lasted and kind != "environment",
            blamed=verdict.blamed if verdict is not None and verdict.blamed else found.blamed,
            contribution={name: np.asarray(part, float) for name, part in found.contribution.items()},
            verdict=kind,
        )
        self._publish(self.latest)
