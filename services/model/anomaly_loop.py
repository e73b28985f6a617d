"""The anomaly loop: the deviation of the body from normal, a change of its environment, and the wrong element."""

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
"""A verdict is made from at most this many of the newest samples above the threshold."""
JUDGE_EVERY = 0.3
"""Verdicts are at least this far apart [s]; one costs as much as about 100 scores."""
VERDICT_RATE = 10.0
"""The loop of the verdicts runs at this rate [Hz]."""
PATIENCE = 1.0
"""An anomaly without a verdict after this time [s] is published without one."""


class AnomalyWatch:
    """The source of one `Anomaly` per tick. A high score counts as an anomaly only after some time.

    While scores are above the threshold, the samples are kept, and `judge` makes verdicts from them. It is slow and
    has a loop of its own.
    """

    def __init__(
        self,
        freshness: Freshness,
        schema: Callable[[], BodySchema],
        after: float,
        publish: Callable[[Anomaly], None],
        clock: Clock,
    ) -> None:
        """Prepare; `after` is the time [s] that the score must stay above its threshold."""
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
        """This holds the time at which the judged scores rose above the threshold, that of the verdict, and it."""
        self.latest: Anomaly | None = None

    def tick(self) -> None:
        """Score the newest sample; NaN and no blame without a fresh sample or without normal data."""
        fresh, values = self._freshness.take()
        schema, known = self._schema(), self._scored
        if known is None or known[0] is not schema or known[1] is not values:  # a sample is scored once
            deviation = deviation_of(schema, in_order(schema, values).flat)
            known = self._scored = schema, values, deviation, deviation.largest(schema)
        deviation = known[2]
        now = self._clock.monotonic()
        cycle = -1 if fresh is None else fresh.message.cycle
        if deviation.distance > deviation.threshold:
            self._above_since = min(self._above_since, now)
            if cycle != self._last_cycle or not self._odd:
                self._odd.append(values)
        else:
            self._above_since = math.inf
            self._odd.clear()
        self._last_cycle = cycle
        self._report(schema, deviation, known[3], cycle, now)

    def judge(self) -> None:
        """Make a verdict if the score has been above the threshold for long enough and the last verdict is old."""
        since, now = self._above_since, self._clock.monotonic()
        is_judged = self._judged is not None and self._judged[0] == since and now - self._judged[1] < JUDGE_EVERY
        if now - since >= self._after and not is_judged:
            self._judged = since, now, judge(self._schema(), list(self._odd))

    def summary(self) -> dict[str, Any]:
        """Return the result of the last tick without the contributions; empty before the first."""
        latest = self.latest
        if latest is None:
            return {}
        return {name: getattr(latest, name) for name in ("score", "threshold", "is_anomaly", "verdict", "blamed")}

    def _report(self, schema: BodySchema, deviation: Deviation, largest: str, cycle: int, now: float) -> None:
        known = self._judged
        verdict = known[2] if known is not None and known[0] == self._above_since else None
        kind = "normal" if deviation.distance <= deviation.threshold else "" if verdict is None else verdict.kind
        has_lasted = now - self._above_since >= self._after + (PATIENCE if verdict is None else 0.0)
        elements = Elements.of({signal.name: signal.size for signal in schema.out_layout.signals})
        self.latest = Anomaly(
            stamp_ns=self._clock.now_ns(),
            cycle=cycle,
            score=deviation.distance,
            threshold=deviation.threshold,
            is_anomaly=has_lasted and kind != "environment",
            blamed=verdict.blamed if verdict is not None and verdict.blamed else largest,
            elements=elements,
            contribution=Numbers(deviation.contribution, elements),
            verdict=kind,
        )
        self._publish(self.latest)
