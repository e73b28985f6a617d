"""A model service without processes, zenoh or real time: samples are given by hand, and its loops run in between."""

from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import zenoh

from gemuco import BodySchema
from hal.by_signal import Elements, Numbers, Truths
from hal.clock import ManualClock
from hal.config import RobotConfig
from services.model import update_loop
from services.model.gemuco_service import GemucoService
from services.process.service import Service
from services.wire import keys
from services.wire.messages import Applied, Message, Sample, Update
from services.wire.streams import Arrival

STEP_COST = 2e-3
"""A step of learning takes this time [s], as on a small computer; in simulated time it would take none."""
HAL_AGE = 2e-3
"""The HAL's values are this old when they arrive [s]."""


class Wire:
    """The part of `Service` that the model service uses: the newest message of a key, and what was published."""

    boot = 1

    def __init__(self) -> None:
        self.arrivals: dict[str, Arrival[Any]] = {}
        self.published: dict[str, Message] = {}
        nothing = SimpleNamespace(handler=SimpleNamespace(try_recv=lambda: None))
        done = SimpleNamespace(attachment=None, payload=zenoh.ZBytes(msgspec.msgpack.encode({"ok": {}})))
        answer = SimpleNamespace(ok=done)
        self.session = SimpleNamespace(declare_subscriber=lambda *_: nothing, get=lambda *_, **__: [answer])

    def newest(self, key: str, record: type[Message]) -> Any:
        """Return a reader of a key; see `Service.newest`."""
        return SimpleNamespace(last=lambda: self.arrivals.get(key), get=lambda age: self._message(key))

    def publisher(self, key: str, record: type[Message]) -> Any:
        """Return a publisher of a key; see `Service.publisher`."""
        return SimpleNamespace(put=lambda message: self.published.update({key: message}))

    def watch(self, *activities: object) -> None:
        """Watch nothing."""

    def _message(self, key: str) -> Message | None:
        arrival = self.arrivals.get(key)
        return None if arrival is None else arrival.message


class LiveService:
    """A model service, its clock, and the next ticks of its loops.

    Attributes:
        model: The service.
        now: Time since the start [s].
    """

    def __init__(self, robot: RobotConfig, schema: BodySchema) -> None:
        """Prepare, at time 0."""
        update_loop.LEAST_COST = STEP_COST
        self._robot, self._wire, self._clock = robot, Wire(), ManualClock()
        self._start, self._numbers = self._clock.monotonic(), {"hal": 0, "camera": 0}
        self.model = GemucoService(robot, schema, cast(Service, self._wire), self._clock)
        self._next = [self._start + loop.offset + 1.0 / loop.rate for loop in self.model.loops]

    @property
    def now(self) -> float:
        """Time since the start [s]."""
        return self._clock.monotonic() - self._start

    def run_until(self, time: float) -> None:
        """Let all loops tick that are due before a time [s since the start]."""
        while True:
            index = int(np.argmin(self._next))
            if self._next[index] > self._start + time:
                break
            self._clock.advance(self._next[index] - self._clock.monotonic())
            self.model.loops[index].tick()
            self._next[index] += 1.0 / self.model.loops[index].rate
        self._clock.advance(max(0.0, self._start + time - self._clock.monotonic()))

    def hal(self, values: dict[str, np.ndarray]) -> None:
        """Let a sample of the HAL arrive now; its values were true `HAL_AGE` ago."""
        self._arrive(keys.sample(self._robot.robot), "hal", values, HAL_AGE)

    def camera(self, values: dict[str, np.ndarray], age: float) -> None:
        """Let a sample of the camera arrive now; its values were true a time [s] ago."""
        self._arrive(keys.vision(self._robot.robot), "camera", values, age)

    def follow(self) -> None:
        """Let the HAL publish that the drives follow, so that the controller may be engaged."""
        signal = self._robot.command.signal
        nothing = np.full(self._robot.signals[signal].size, np.nan)
        applied = Applied(
            cycle=0, mode="follow", signal=signal, desired=nothing, values=nothing, limited_by=[], sender=0
        )
        self._wire.arrivals[keys.applied(self._robot.robot)] = Arrival(applied, self._clock.monotonic())

    @property
    def command(self) -> np.ndarray | None:
        """Newest command of the controller [its unit], shape (n,); None before the first."""
        command: Any = self._wire.published.get(keys.command(self._robot.robot))
        return None if command is None else np.asarray(command.values, float)

    @property
    def updated(self) -> Update:
        """Newest state of the online update."""
        state: Any = self._wire.published[keys.update(self._robot.robot)]
        return state

    def _arrive(self, key: str, source: str, values: dict[str, np.ndarray], age: float) -> None:
        self._numbers[source] += 1
        number, elements = self._numbers[source], Elements.of({name: len(value) for name, value in values.items()})
        flat = np.concatenate(list(values.values()))
        sample = Sample(
            cycle=number, boot=7, seq=number, stamp_ns=self._clock.now_ns(), source="simulated", complete=True,
            values=Numbers(flat, elements), age=Numbers(np.full(len(flat), age), elements),
            valid=Truths(np.ones(len(flat), bool), elements),
        )  # fmt: skip
        self._wire.arrivals[key] = Arrival(sample, self._clock.monotonic())
