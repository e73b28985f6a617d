"""The update loop: it learns p and W online from a bounded window, and replaces the whole model."""

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from msgspec.structs import replace

from gemuco.adaption.update import SPREAD
from gemuco.anomaly.healthy import learn_normal
from gemuco.errors import NotEnoughData
from gemuco.schema import BodySchema
from hal.clock import Clock
from services.model.estimation import Freshness
from services.model.living_model import LivingModel
from services.model.model_config import UpdateConfig
from services.wire.messages import Update

log = logging.getLogger(__name__)

BUDGET = 0.25
"""Gradient steps take at most about this share of a tick's period; the rest are taken in the next ticks."""
STEP_COST = 2e-3
"""A gradient step takes this time [s] until it was measured."""
LEAST_COST = 1e-4
"""A gradient step takes at least this time [s]."""
COST_MEMORY = 0.2
"""Each tick moves the measured time of a gradient step by this share."""
APART = 0.25
"""A model with another W but the same p replaces the one in use after at least this time [s]: every replacement costs
the other loops a search and new statistics, and W moves little in this time."""
PAST = 32
"""This number of models is kept, to go back if a sensor lied: 8 s of them."""
DOUBTED_SINCE = 2.0
"""A sensor may have lied for this time [s] before it is suspected."""
NORMAL_AFTER = 200
"""After an update of W normal errors are learned anew as soon as this number of samples came, or the window is full."""

Values = Mapping[str, np.ndarray]
"""Signal -> value [its unit], shape (n,)."""


class BodyUpdater(Protocol):
    """An updater of p and W with its own window (`gemuco.adaption.update.Updater`)."""

    schema: BodySchema

    @property
    def samples(self) -> np.ndarray:
        """Samples of the window, oldest first, shape (n, size)."""
        ...

    def add(self, values: Mapping[str, np.ndarray]) -> bool:
        """Add one complete sample [unit]; return whether it is of use."""
        ...

    def forget(self, count: int, schema: BodySchema) -> None:
        """Drop this number of the newest samples, and go on from the schema before them."""
        ...

    def step(self, most: int) -> Any:
        """Make at most this many gradient steps; return a `gemuco.adaption.update.UpdateResult`."""
        ...


class OnlineUpdate:
    """The online update: it collects samples while the robot moves; while active, it learns and replaces the model.

    Samples since the last change of the model are kept apart. Normal errors are learned from these, because the errors
    on samples that the model was fitted to do not represent its errors on others.
    """

    def __init__(
        self,
        freshness: Freshness,
        living: LivingModel,
        config: UpdateConfig,
        learner: Callable[[BodySchema], BodyUpdater],
        is_engaged: Callable[[], bool],
        publish: Callable[[Update], None],
        clock: Clock,
        may_learn: Callable[[], bool] = lambda: True,
        is_doubted: Callable[[], bool] = lambda: False,
        learned: Callable[[BodySchema], None] = lambda schema: None,
        period: float = 0.1,
    ) -> None:
        """Prepare.

        Args:
            freshness: Source of samples.
            living: The model in use.
            config: The `update` section of the robot file.
            learner: Makes an updater that starts from a schema, with an empty window.
            is_engaged: Whether the controller moves the robot; samples at rest count only then.
            publish: Publishes the state.
            clock: Source of time.
            may_learn: Whether learning is allowed in this tick; if not, samples are only collected.
            is_doubted: Whether a sensor is suspected of a gross lie and still used; no sample is taken then.
            learned: Called with a model whose normal errors were learned from this body.
            period: Time between two ticks [s].
        """
        self._may_learn, self._is_doubted, self._learned = may_learn, is_doubted, learned
        self._awaits_normal = False
        self.waited = 0
        """This is the number of ticks in which learning was not allowed."""
        self._period, self._cost = period, STEP_COST
        self._freshness, self._living, self._config = freshness, living, config
        self._is_engaged = is_engaged
        self._make_learner, self._publish, self._clock = learner, publish, clock
        self._lock = threading.Lock()
        self._learner: BodyUpdater | None = None
        self._used = living.schema
        """The learner's model when it began, or when it last replaced the one in use."""
        self._since_change: deque[tuple[float, Values]] = deque(maxlen=config.window)
        """Times [s] and samples since the model changed."""
        self._known = living.schema.normal
        """What was normal before these samples; what was learned from some of them is no knowledge beside them."""
        self._added: deque[float] = deque(maxlen=config.window)
        """Times [s] of the samples that the learner got."""
        self._past: deque[tuple[float, BodySchema]] = deque(maxlen=PAST)
        """Times [s] and models of the newest replacements, the first of which may be the model before the update."""
        self._was_doubted, self._lied_since = False, math.inf
        self._last: np.ndarray | None = None
        self._awaits_first = False
        self._taken_at = self._swapped_at = -math.inf
        self._state = Update(active=False, model_version=0, window=0, dropped=0, loss=math.nan)

    @property
    def is_active(self) -> bool:
        """Whether p and W are being updated."""
        return self._learner is not None

    def adapt(self, active: bool) -> None:
        """Start from the model in use, or stop and keep the model."""
        with self._lock:
            if active and self._learner is None:
                self._living.keep()
                self._learner, self._used = self._make_learner(self._living.schema), self._living.schema
                self._added.clear()
                self._past = deque([(-math.inf, self._used)], PAST)
                # One sample may determine p, even of a robot at rest.
                self._awaits_first = len(self._living.schema.bias) > 0
            elif not active:
                self._use(self._learner)
                before = self._living.before
                if self._learner is not None and before is not None:
                    self._awaits_normal |= before.weights is not self._living.schema.weights
                self._learner, self._awaits_first = None, False
                self._begin()

    def rollback(self) -> int:
        """Stop, and restore the model before adaption began; return the model's version."""
        with self._lock:
            self._learner, self._awaits_first, self._awaits_normal = None, False, False
            version = self._living.rollback()
            self._begin()
            return version

    def learn_normal(self) -> int:
        """Learn the normal errors from the samples since the model last changed; return the number of samples.

        Raises:
            NotEnoughData: The robot moved too little.
        """
        with self._lock:
            return self._learn_normal()

    def forget(self, since: float) -> None:
        """Learn nothing more from samples after a time [s]: a sensor lied in them. The next tick goes back."""
        with self._lock:
            self._forget(since)

    def _forget(self, since: float) -> None:
        while self._since_change and self._since_change[-1][0] >= since:
            self._since_change.pop()
        self._lied_since = min(self._lied_since, since)

    def _go_back(self) -> None:
        """Let the learner drop the samples in which a sensor lied, and go on from the model before them."""
        since, self._lied_since = self._lied_since, math.inf
        lying = 0
        while self._added and self._added[-1] >= since:
            self._added.pop()
            lying += 1
        if self._learner is not None and lying:
            while len(self._past) > 1 and self._past[-1][0] >= since:
                self._past.pop()
            self._learner.forget(lying, self._past[-1][1])
            self._use(self._learner)

    def _begin(self) -> None:
        """Collect samples anew, because the model changed."""
        self._since_change.clear()
        self._known = self._living.schema.normal

    def _learn_normal(self) -> int:
        samples = [sample for _, sample in self._since_change]
        schema = self._living.schema
        try:
            if not samples:
                raise NotEnoughData("No complete sample of the moving robot came since the model last changed.")
            rows = np.array([schema.layout.join_one(sample) for sample in samples])
            normal = learn_normal(schema.with_normal(self._known), rows)
        except NotEnoughData as error:
            raise NotEnoughData(f"{error} Let the robot move for a while with the update stopped.") from None
        schema = schema.with_normal(normal)
        self._living.swap(schema)
        self._learned(schema)
        self._awaits_normal = False
        return len(samples)

    def tick(self) -> None:
        """Add the newest sample if the robot moves or is engaged, and learn if active."""
        with self._lock:
            sample, moved = self._believed()
            self._go_back()
            if sample is not None and _is_complete(sample) and (moved or self._is_engaged()):
                self._since_change.append((self._clock.monotonic(), sample))
            if self._learner is not None and not self._may_learn():
                self.waited += 1
                if moved and sample is not None:
                    self._add(self._learner, sample)
                count = len(self._learner.samples)
                self._state = replace(self._state, stamp_ns=self._clock.now_ns(), active=True, window=count)
            elif self._learner is None:
                if self._awaits_normal and len(self._since_change) >= min(NORMAL_AFTER, self._config.window):
                    self._try_normal()
                self._state = Update(
                    stamp_ns=self._clock.now_ns(),
                    active=False,
                    model_version=self._living.version,
                    window=len(self._since_change),
                    dropped=0,
                    loss=self._state.loss,
                    bias=np.asarray(self._living.schema.bias, float),
                    rolled_back=self._state.rolled_back,
                )
            else:
                self._state = self._learn(self._learner, sample if moved else None)
            state = self._state
        self._publish(state)

    def _try_normal(self) -> None:
        """Learn the normal errors after an update of W, or log why that is not possible."""
        try:
            log.info("Learned what is normal from %d samples after the update", self._learn_normal())
        except NotEnoughData as error:
            log.warning("Normal errors were not learned after the update: %s", error)
            self._awaits_normal = False

    def _add(self, learner: BodyUpdater, sample: Values) -> None:
        if learner.add(sample):
            self._added.append(self._clock.monotonic())

    def _believed(self) -> tuple[Values | None, bool]:
        """Return the newest sample, as `_newest`; none while a sensor is suspected of a gross lie."""
        was_doubted, self._was_doubted = self._was_doubted, self._is_doubted()
        if not self._was_doubted:
            return self._newest()
        if not was_doubted:
            self._forget(self._clock.monotonic() - DOUBTED_SINCE)
        return None, False

    def _newest(self) -> tuple[Values | None, bool]:
        """Return the newest sample, and whether it is far enough in motion and time from the last to be learned from.

        An incomplete sample still determines p. A model without p does not use it: W would drift in the signals that
        are not measured, and no data of another condition hold it.
        """
        fresh, values = self._freshness.together()
        if fresh is None:
            return None, False
        row = self._living.schema.normalise(values)
        if not len(self._living.schema.bias) and not np.isfinite(row).all():
            return None, False
        now = self._clock.monotonic()
        if now - self._taken_at < 0.9 * self._config.interval:
            return values, False
        distance = np.full(1, math.inf) if self._last is None else np.abs(row - self._last)
        is_far = not np.isfinite(distance).any() or float(np.nanmax(distance)) >= SPREAD
        if not is_far and not self._awaits_first:
            return values, False
        moved = self._last is not None or self._awaits_first
        self._awaits_first, self._last, self._taken_at = False, row, now
        return values, moved

    def _learn(self, learner: BodyUpdater, sample: Values | None) -> Update:
        if sample is not None:
            self._add(learner, sample)
        started = self._clock.monotonic()
        result = learner.step(max(1, int(BUDGET * self._period / self._cost)))
        if result.steps:
            cost = (self._clock.monotonic() - started) / result.steps
            self._cost = max(LEAST_COST, self._cost + COST_MEMORY * (cost - self._cost))
        is_due = started - self._swapped_at >= 0.99 * APART
        if result.window and (is_due or not np.array_equal(learner.schema.bias, self._living.schema.bias)):
            self._use(learner)
        return Update(
            stamp_ns=self._clock.now_ns(),
            active=True,
            model_version=self._living.version,
            window=int(result.window),
            dropped=int(result.dropped),
            loss=float(result.loss),
            bias=np.asarray(result.bias, float),
            settled=bool(result.settled),
            rolled_back=int(result.rolled_back),
        )

    def _use(self, learner: BodyUpdater | None) -> None:
        """Let a learner's model replace the one in use, if it learned something since the last time."""
        if learner is not None and learner.schema is not self._used:
            self._used = learner.schema
            self._living.swap(learner.schema)
            self._swapped_at = self._clock.monotonic()
            self._past.append((self._swapped_at, learner.schema))
            self._begin()


def _is_complete(sample: Mapping[str, np.ndarray]) -> bool:
    return all(np.isfinite(value).all() for value in sample.values())
