"""The anomaly loop: how unlike normal the body is, whether its environment changed, and which element is wrong."""

import math
from collections import deque
from collections.abc import Callable
from typing import Any

from gemuco.anomaly.score import Deviation, deviation_of
from gemuco.anomaly.verdict import Verdict, judge
from gemuco.schema import BodySchema
from hal.by_signal import Elements, Numbers
from hal.clock import Clock
from services.model.estimation import Freshness, in_order
from services.wire.messages import Anomaly

ODD = 10
"""Newest samples above the threshold that a verdict is made from."""
JUDGE_EVERY = 0.3
"""Time [s] between two verdicts; one costs as much as some hundred scores."""
VERDICTS = 10.0
"""How often [Hz] it is looked whether a verdict is due."""
PATIENCE = 1.0
"""An anomaly that nobody came to judge within this time [s] is told without a verdict."""


class AnomalyWatch:
    """Makes one `Anomaly` per tick; an anomaly is one only after it has lasted.

    While scores are above the threshold the samples are kept, and a verdict is made from all of them now and then: by
    `judge`, which is slow and belongs into a loop of its own.
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
        self._odd: deque[Numbers] = deque(maxlen=ODD)
        self._last_cycle = -1
        self._scored: tuple[BodySchema, Numbers, Deviation, str] | None = None
        self._judged: tuple[float, float, Verdict] | None = None
        """When the scores that were judged rose above the threshold, when the verdict was made, and the verdict."""
        self.latest: Anomaly | None = None

    def tick(self) -> None:
        """Score the newest sample; NaN, and nobody is blamed, without a fresh one or without normal data."""
        fresh, values = self._freshness.take()
        schema, known = self._schema(), self._scored
        if known is None or known[0] is not schema or known[1] is not values:  # a sample is scored once
            score = deviation_of(schema, in_order(schema, values).flat)
            known = self._scored = schema, values, score, score.largest(schema)
        found = known[2]
        now = self._clock.monotonic()
        cycle = -1 if fresh is None else fresh.message.cycle
        if found.distance > found.threshold:
            self._above_since = min(self._above_since, now)
            if cycle != self._last_cycle or not self._odd:
                self._odd.append(values)
        else:
            self._above_since = math.inf
            self._odd.clear()
        self._last_cycle = cycle
        self._tell(schema, found, known[3], cycle, now)

    def judge(self) -> None:
        """Make a verdict if one is due: the score has been above the threshold for long enough, and the last is old."""
        since, now = self._above_since, self._clock.monotonic()
        is_judged = self._judged is not None and self._judged[0] == since and now - self._judged[1] < JUDGE_EVERY
        if now - since >= self._after and not is_judged:
            self._judged = since, now, judge(self._schema(), list(self._odd))

    def summary(self) -> dict[str, Any]:
        """What the last tick found, without the parts of each signal; empty before the first."""
        latest = self.latest
        if latest is None:
            return {}
        return {name: getattr(latest, name) for name in ("score", "threshold", "is_anomaly", "verdict", "blamed")}

    def _tell(self, schema: BodySchema, found: Deviation, largest: str, cycle: int, now: float) -> None:
        known = self._judged
        verdict = known[2] if known is not None and known[0] == self._above_since else None
        kind = "normal" if found.distance <= found.threshold else "" if verdict is None else verdict.kind
        has_lasted = now - self._above_since >= self._after + (PATIENCE if verdict is None else 0.0)
        elements = Elements.of({one.name: one.size for one in schema.out_layout.signals})
        self.latest = Anomaly(
            stamp_ns=self._clock.now_ns(),
            cycle=cycle,
            score=found.distance,
            threshold=found.threshold,
            is_anomaly=has_lasted and kind != "environment",
            blamed=verdict.blamed if verdict is not None and verdict.blamed else largest,
            elements=elements,
            contribution=Numbers(found.contribution, elements),
            verdict=kind,
        )
        self._publish(self.latest)
