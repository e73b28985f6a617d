"""The anomaly loop: the deviation of the body from normal, a change of its environment, and the wrong element."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from gemuco.anomaly.prediction import judgements
from gemuco.anomaly.score import Deviation, deviation_of
from gemuco.anomaly.verdict import HARMLESS, Verdict, judge, window_score
from gemuco.schema import BodySchema
from hal.by_signal import Elements, Numbers
from hal.clock import Clock
from services.model.acquaintance import Acquaintance
from services.model.estimation import Freshness, in_order
from services.wire.messages import Anomaly

ODD = 10
"""A verdict is made from at most this many of the newest samples above the threshold."""
WINDOWS = (10, 30, 100)
"""A small deviation that lasts is found in windows of these numbers of samples."""
APART = 0.1
"""Samples of a window are this far apart in time [s], as those from which normal errors are learned."""
GAP = 1.0
"""A window ends when no sample came for this time [s]."""
JUDGE_EVERY = 0.3
"""Verdicts are at least this far apart [s]; one costs as much as about 100 scores."""
VERDICT_RATE = 10.0
"""The loop of the verdicts runs at this rate [Hz]."""
PATIENCE = 1.0
"""An anomaly without a verdict after this time [s] is published without one."""
UNKNOWN = "unknown"
"""This verdict says that what is normal has not been learned on this body yet, or that p is beyond the trained ones."""


class _Judged(NamedTuple):
    """A verdict: since when the judged samples are odd [s], when it was made [s], and the verdict."""

    since: float
    at: float
    verdict: Verdict


class AnomalyWatch:
    """The source of one `Anomaly` per tick. A high score counts as an anomaly only after some time.

    While scores are above the threshold, the samples are kept, and `judge` makes verdicts from them. It also looks for
    small deviations in longer windows. It is slow and has a loop of its own.
    """

    def __init__(
        self,
        freshness: Freshness,
        schema: Callable[[], BodySchema],
        after: float,
        publish: Callable[[Anomaly], None],
        clock: Clock,
        acquaintance: Acquaintance | None = None,
    ) -> None:
        """Prepare.

        Args:
            freshness: Source of samples.
            schema: Returns the model in use.
            after: Time [s] that the score must stay above its threshold.
            publish: Publishes the state.
            clock: Source of time.
            acquaintance: Judge of whether the model's normal errors are those of this body; without it they are.
        """
        self._freshness, self._schema, self._after, self._publish, self._clock = (
            freshness,
            schema,
            after,
            publish,
            clock,
        )
        self._acquaintance = acquaintance
        self._above_since = math.inf
        self._odd: deque[Numbers] = deque(maxlen=ODD)
        self._recent: deque[tuple[float, Numbers]] = deque(maxlen=WINDOWS[-1])
        self._lasting_since = math.inf
        self._last: Numbers | None = None
        self._scored: tuple[BodySchema, Numbers, Deviation, str] | None = None
        self._wanted: np.ndarray | None = None
        self._judged: _Judged | None = None
        self._rival = ""
        """This is the element that the last verdict blamed instead of the published one."""
        self.latest: Anomaly | None = None

    def tick(self) -> None:
        """Score the newest sample; NaN and no blame without a fresh sample or without normal data."""
        fresh, values = self._freshness.together()
        schema, known = self._schema(), self._scored
        now = self._clock.monotonic()
        if known is not None and known[0].normal is not schema.normal:
            self._begin()
        if known is None or known[0] is not schema or known[1] is not values:  # a sample is scored once
            deviation = self._score(schema, in_order(schema, values).flat)
            known = self._scored = schema, values, deviation, deviation.largest(schema)
        deviation = known[2]
        cycle = -1 if fresh is None else fresh.message.cycle
        is_odd, is_new = deviation.distance > deviation.threshold, values is not self._last
        if is_odd:
            self._above_since = min(self._above_since, now)
            if is_new or not self._odd:
                self._odd.append(values)
        else:
            self._above_since = math.inf
            self._odd.clear()
        if fresh is not None and is_new and math.isfinite(deviation.distance):
            self._keep(schema, values, is_odd, now)
        self._last = values
        self._report(schema, deviation, known[3], cycle, now)

    def _begin(self) -> None:
        """Begin anew, because other statistics say what is normal."""
        self._above_since = self._lasting_since = math.inf
        self._judged = None
        self._odd.clear()

    def judge(self) -> None:
        """Make a verdict if the body has been odd for long enough and the last verdict is old."""
        schema, now = self._schema(), self._clock.monotonic()
        if self._wanted is not None:
            schema.derived(judgements)(self._wanted)
            self._wanted = None
        if not self._is_known(schema):
            return
        lasting = self._lasting(schema)
        self._lasting_since = min(self._lasting_since, now) if lasting else math.inf
        since = min(self._above_since, self._lasting_since)
        judged = self._judged
        is_judged = judged is not None and judged.since == since and now - judged.at < JUDGE_EVERY
        if now - since >= self._after and not is_judged:
            verdict = judge(schema, list(self._odd) if self._above_since <= since else lasting)
            self._judged = _Judged(since, now, self._steady(since, verdict))

    def forget(self) -> None:
        """Begin new windows, because a sensor lied in these samples and is hidden now, or is used again."""
        self._recent.clear()

    def summary(self) -> dict[str, Any]:
        """Return the result of the last tick without the contributions; empty before the first."""
        latest = self.latest
        if latest is None:
            return {}
        names = ("score", "threshold", "is_anomaly", "verdict", "blamed")
        normal = self._schema().normal
        return {name: getattr(latest, name) for name in names} | {"normal": "" if normal is None else normal.trust}

    def _score(self, schema: BodySchema, joined: np.ndarray) -> Deviation:
        """Score a sample; while another element is missing for the first time, wait for the verdicts' loop.

        Statistics for a new set of measured elements take as long as several ticks.
        """
        finite = np.isfinite(joined)
        if not finite.all() and not schema.derived(judgements).is_ready(finite):
            self._wanted = finite
            return Deviation(math.nan, math.nan, np.full(len(joined), np.nan))
        return deviation_of(schema, joined)

    def _is_known(self, schema: BodySchema) -> bool:
        return self._acquaintance is None or self._acquaintance.is_known(schema)

    def _keep(self, schema: BodySchema, values: Numbers, is_odd: bool, now: float) -> None:
        """Keep one sample per `APART` for the windows and for the trial of the normal errors."""
        last = self._recent[-1][0] if self._recent else -math.inf
        if now - last > GAP:
            self._recent.clear()
        if now - last < 0.9 * APART:
            return
        self._recent.append((now, values))
        if self._acquaintance is not None:
            self._acquaintance.see(schema, is_odd, now)

    def _lasting(self, schema: BodySchema) -> list[Numbers]:
        """Return the samples of the shortest window that is further from normal than a healthy body's; else none."""
        recent = [values for _, values in self._recent.copy()]
        rows = np.array([schema.scaler.normalise(in_order(schema, values).flat) for values in recent])
        for count in WINDOWS:
            if len(recent) >= count and window_score(schema, rows[-count:]) > 1.0:
                return recent[-count:]
        return []

    def _steady(self, since: float, verdict: Verdict) -> Verdict:
        """Return the verdict with the element that was blamed before, unless two verdicts in a row blame another."""
        before = self._judged
        is_first = before is None or before.since != since or before.verdict.kind != verdict.kind
        if before is None or is_first or not before.verdict.blamed or not verdict.blamed:
            self._rival = ""
            return verdict
        blamed = before.verdict.blamed
        is_new = verdict.blamed in (blamed, self._rival)
        self._rival = "" if is_new else verdict.blamed
        return verdict if is_new else replace(verdict, blamed=blamed)

    def _report(self, schema: BodySchema, deviation: Deviation, largest: str, cycle: int, now: float) -> None:
        since, known = min(self._above_since, self._lasting_since), self._judged
        verdict = known.verdict if known is not None and known.since == since and math.isfinite(since) else None
        is_known, is_scored = self._is_known(schema), math.isfinite(deviation.distance)
        kind = "" if verdict is None else verdict.kind
        if math.isinf(since):
            kind = "normal" if deviation.distance <= deviation.threshold else ""
        blamed = verdict.blamed if verdict is not None and verdict.blamed else largest
        has_lasted = now - since >= self._after + (PATIENCE if verdict is None else 0.0)
        elements = Elements.of({signal.name: signal.size for signal in schema.layout.signals})
        self.latest = Anomaly(
            stamp_ns=self._clock.now_ns(),
            cycle=cycle,
            score=deviation.distance,
            threshold=deviation.threshold,
            is_anomaly=is_known and has_lasted and kind not in HARMLESS,
            blamed=blamed if is_known else "",
            elements=elements,
            contribution=Numbers(deviation.contribution, elements),
            verdict=kind if is_known or not is_scored else UNKNOWN,
        )
        self._publish(self.latest)
