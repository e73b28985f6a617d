"""The update loop: p and W learn online from a bounded window, and every model they make is swapped in whole."""

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from msgspec.structs import replace

from gemuco.anomaly.prediction import predict_error
from gemuco.errors import NotEnoughData
from gemuco.normal import Normal
from gemuco.schema import BodySchema
from hal.clock import Clock
from services.model.estimation import Freshness
from services.model.living_model import LivingModel
from services.model.model_config import UpdateConfig
from services.wire.messages import Update

SPREAD = 0.1
"""A sample joins the learner's window when some element moved this far since the last [standard deviations]: a robot
that rests would fill it with one posture."""


Values = Mapping[str, np.ndarray]
"""Signal -> value [its unit], shape (n,)."""


class Learner(Protocol):
    """An updater of p and W with a window of its own (`gemuco.adaption.update.Updater`)."""

    schema: BodySchema

    def add(self, values: Mapping[str, np.ndarray]) -> Any:
        """Take one complete sample [unit]."""
        ...

    def step(self) -> Any:
        """Learn a little; the result is `gemuco.adaption.update.UpdateResult`."""
        ...


class OnlineUpdate:
    """Gathers samples while the robot moves; while active, learns from them and swaps the model.

    Samples since the model last changed are kept apart: what is normal is learned from those, because the errors a
    model makes on what it was fitted to say nothing of its errors elsewhere.
    """

    def __init__(
        self,
        freshness: Freshness,
        living: LivingModel,
        config: UpdateConfig,
        learner: Callable[[BodySchema], Learner],
        is_engaged: Callable[[], bool],
        publish: Callable[[Update], None],
        clock: Clock,
        may_learn: Callable[[], bool] = lambda: True,
    ) -> None:
        """`learner` makes an updater that starts from a schema, with an empty window.

        `is_engaged` tells whether the robot is being moved; a robot at rest is of interest only then. While `may_learn`
        says no, samples are taken and nothing is learned from them.
        """
        self._may_learn = may_learn
        self.waited = 0
        """Ticks in which it might not learn."""
        self._freshness, self._living, self._config = freshness, living, config
        self._is_engaged = is_engaged
        self._make_learner, self._publish, self._clock = learner, publish, clock
        self._lock = threading.Lock()
        self._learner: Learner | None = None
        self._since_change: deque[Values] = deque(maxlen=config.window)
        self._last: np.ndarray | None = None
        self._awaits_first = False
        self._taken_at = -math.inf
        self._told = Update(active=False, model_version=0, window=0, dropped=0, loss=math.nan)

    @property
    def is_active(self) -> bool:
        """Whether p and W are being updated."""
        return self._learner is not None

    def adapt(self, active: bool) -> None:
        """Start from the model in use, or stop; the model stays as it is then."""
        with self._lock:
            if active and self._learner is None:
                self._living.keep()
                self._learner = self._make_learner(self._living.schema)
                # One sample may tell what p is, and the robot may rest when it is asked to learn.
                self._awaits_first = len(self._living.schema.bias) > 0
            elif not active:
                self._learner, self._awaits_first = None, False
                self._since_change.clear()

    def rollback(self) -> int:
        """Stop, and go back to the model before adaption began; returns the model's version."""
        with self._lock:
            self._learner, self._awaits_first = None, False
            self._since_change.clear()
            return self._living.rollback()

    def learn_normal(self) -> int:
        """Learn what errors are normal from the samples since the model last changed; returns how many.

        Raises:
            NotEnoughData: The robot moved too little since.
        """
        with self._lock:
            samples = list(self._since_change)
            schema = self._living.schema
            try:
                if not samples:
                    raise NotEnoughData("No whole sample of the moving robot came since the model last changed.")
                rows = {name: np.stack([sample[name] for sample in samples]) for name in samples[0]}
                normal = Normal.fit(predict_error(schema, rows), schema.scaler.std[schema.out_index])
            except NotEnoughData as error:
                raise NotEnoughData(f"{error} Let the robot move for a while with the update stopped.") from None
            self._living.swap(schema.with_normal(normal))
            return len(samples)

    def tick(self) -> None:
        """Take the newest sample if the robot moves or is engaged, and learn if active."""
        with self._lock:
            sample, moved = self._newest()
            if sample is not None and _is_whole(sample) and (moved or self._is_engaged()):
                self._since_change.append(sample)
            if self._learner is not None and not self._may_learn():
                self.waited += 1
                if moved and sample is not None:
                    self._learner.add(sample)
                told = replace(self._told, stamp_ns=self._clock.now_ns(), active=True)
            elif self._learner is None:
                told = Update(
                    stamp_ns=self._clock.now_ns(),
                    active=False,
                    model_version=self._living.version,
                    window=len(self._since_change),
                    dropped=0,
                    loss=self._told.loss,
                    bias=np.asarray(self._living.schema.bias, float),
                    rolled_back=self._told.rolled_back,
                )
            else:
                told = self._learn(self._learner, sample if moved else None)
            self._told = told
        self._publish(told)

    def _newest(self) -> tuple[Values | None, bool]:
        """The newest sample, and whether it is far and late enough to be learned from.

        A sample that lacks something still tells p, from whatever is left. Where there is no p it is not taken: W would
        drift where nothing is measured, and no other condition's data hold it.
        """
        fresh, values = self._freshness.take()
        if fresh is None:
            return None, False
        row = self._living.schema.normalise(values)
        if not len(self._living.schema.bias) and not np.isfinite(row).all():
            return None, False
        now = self._clock.monotonic()
        if now - self._taken_at < 0.9 * self._config.interval:
            return values, False
        away = np.full(1, math.inf) if self._last is None else np.abs(row - self._last)
        far = not np.isfinite(away).any() or float(np.nanmax(away)) >= SPREAD
        if not far and not self._awaits_first:
            return values, False
        moved = self._last is not None or self._awaits_first
        self._awaits_first, self._last, self._taken_at = False, row, now
        return values, moved

    def _learn(self, learner: Learner, sample: Values | None) -> Update:
        if sample is not None:
            learner.add(sample)
        result = learner.step()
        if learner.schema is not self._living.schema and result.window:
            self._living.swap(learner.schema)
            self._since_change.clear()
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


def _is_whole(sample: Mapping[str, np.ndarray]) -> bool:
    return all(np.isfinite(value).all() for value in sample.values())
