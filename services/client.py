"""A remote client in ten lines: read the newest of everything, ask for what a robot can do."""

import time
from collections.abc import Iterable, Mapping, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
import zenoh

from services import keys, query
from services.errors import ServiceUnavailable
from services.messages import Anomaly, Applied, Command, Estimates, Message, Sample, Status, Target, Update
from services.session import CLIENT, close_session, new_boot, open_session
from services.streams import Newest, Publisher

M = TypeVar("M", bound=Message)

FRESH = 0.25
"""Age [s], on this machine's clock, up to which a message is handed out; an older one is None."""
FRESH_STATUS = 2.5
TIMEOUT = 2.0
"""Deadline [s] of a verb."""
SLOW_TIMEOUT = 10.0
"""Deadline [s] of a verb that computes."""
LONG_TIMEOUT = 60.0
"""Deadline [s] of a verb that computes step after step."""


class Client:
    """Reads a robot and asks it, from any process.

        with Client("musashi_arm") as arm:
            print(arm.estimate(timeout=2.0))

    The readers return None rather than something old, and subscribe when first used. Every verb raises what the
    service raised, or `ServiceUnavailable` when nobody answers in time.

    Args:
        robot: The robot's name.
        connect: More zenoh endpoints, such as a router's, for a robot on another machine.
    """

    session: zenoh.Session

    def __init__(self, robot: str, connect: Iterable[str] = ()) -> None:
        self.robot = robot
        self.boot = new_boot()
        self._connect = tuple(connect)
        self._readers: dict[str, Newest[Any]] = {}
        self._publishers: dict[str, Publisher[Any]] = {}

    def __enter__(self) -> Self:
        self.session = open_session(self.robot, CLIENT, self._connect)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        close_session(self.session)

    def sample(self, max_age: float = FRESH, timeout: float = 0.0) -> Sample | None:
        """The newest measurement; None if none arrived in the last `max_age` [s], nor while waiting `timeout` [s]."""
        return self._fresh(keys.sample(self.robot), Sample, max_age, timeout)

    def vision(self, max_age: float = FRESH, timeout: float = 0.0) -> Sample | None:
        """What a camera saw last, or None; see `sample`."""
        return self._fresh(keys.vision(self.robot), Sample, max_age, timeout)

    def applied(self, max_age: float = FRESH, timeout: float = 0.0) -> Applied | None:
        """What was last sent to the drives, or None; see `sample`."""
        return self._fresh(keys.applied(self.robot), Applied, max_age, timeout)

    def estimate(
        self,
        values: Mapping[str, Sequence[float] | np.ndarray] | None = None,
        hide: Iterable[str] = (),
        *,
        max_age: float = FRESH,
        timeout: float = 0.0,
    ) -> Estimates | None:
        """The newest estimate of every signal, or None; see `sample`.

        With values, or with signals to hide, the model estimates from those instead, as `BodySchema.estimate` does.
        """
        hidden = list(hide)
        if values is None and not hidden:
            return self._fresh(keys.estimate(self.robot), Estimates, max_age, timeout)
        found = self.ask("model", "estimate", _given(values) | {"hide": hidden}, SLOW_TIMEOUT)
        signals: dict[str, dict[str, Any]] = found["signals"]
        return Estimates(
            cycle=found["cycle"],
            values={name: np.array(one["values"], float) for name, one in signals.items()},
            estimated={name: np.array(one["estimated"], bool) for name, one in signals.items()},
            std={name: np.array(one["std"], float) for name, one in signals.items()},
            method={name: one["method"] for name, one in signals.items()},
            mask={name: one["mask"] for name, one in signals.items()},
            residual={name: one["residual"] for name, one in signals.items()},
        )

    def anomaly(
        self,
        values: Mapping[str, Sequence[float] | np.ndarray] | None = None,
        hide: Iterable[str] = (),
        *,
        max_age: float = FRESH,
        timeout: float = 0.0,
    ) -> Anomaly | None:
        """The newest anomaly score, or None; see `sample`.

        With values, or with signals to hide, the model judges those instead, as `BodySchema.anomaly` does: one sample
        by itself, however long.
        """
        hidden = list(hide)
        if values is None and not hidden:
            return self._fresh(keys.anomaly(self.robot), Anomaly, max_age, timeout)
        found = self.ask("model", "anomaly", _given(values) | {"hide": hidden}, SLOW_TIMEOUT)
        contribution = {name: np.array(part, float) for name, part in found["contribution"].items()}
        names = ("cycle", "score", "threshold", "is_anomaly", "blamed")
        return Anomaly(contribution=contribution, **{name: found[name] for name in names})

    def update(self, max_age: float = 4 * FRESH, timeout: float = 0.0) -> Update | None:
        """What the online update does, or None; see `sample`."""
        return self._fresh(keys.update(self.robot), Update, max_age, timeout)

    def truth(self, max_age: float = FRESH, timeout: float = 0.0) -> Sample | None:
        """What a simulator knows to be true, or None; see `sample`."""
        return self._fresh(keys.truth(self.robot), Sample, max_age, timeout)

    def status(self, service: str, max_age: float = FRESH_STATUS, timeout: float = 0.0) -> Status | None:
        """The newest status of a service, or None; see `sample`."""
        return self._fresh(keys.status(self.robot, service), Status, max_age, timeout)

    def next_sample(self, timeout: float = TIMEOUT) -> Sample | None:
        """Wait for the next measurement; None if none arrives within `timeout` [s]."""
        return self.reader(keys.sample(self.robot), Sample).wait(timeout)

    def command(self, signal: str, values: np.ndarray, answers: Sample) -> None:
        """Send desired values to the drives; the HAL follows while they are younger than the time to live.

        Args:
            signal: The commanded signal.
            values: Desired values [its unit], shape (n,).
            answers: The sample that the command was made from; its age is the command's age.
        """
        message = Command(
            stamp_ns=time.time_ns(), signal=signal, values=np.asarray(values, float), cycle=answers.cycle,
            hal_boot=answers.boot,
        )  # fmt: skip
        self._publisher(keys.command(self.robot), Command).put(message)

    def target(self, signal: str, values: Sequence[float] | np.ndarray, timeout: float = TIMEOUT) -> None:
        """Tell the controller where to bring the body; it moves only while engaged.

        Args:
            signal: Signal to reach, such as `joint_position`.
            values: Reference [its unit], shape (n,).
            timeout: How long [s] to wait for a model service that listens.

        Raises:
            ServiceUnavailable: None listens.
        """
        publisher = self._publisher(keys.target(self.robot), Target)
        deadline = time.monotonic() + timeout
        while not publisher.has_listener:
            if time.monotonic() > deadline:
                raise ServiceUnavailable(
                    f"No 'model' service of robot '{self.robot}' takes targets. Is `gemuco serve` running?"
                )
            time.sleep(query.RETRY_AFTER)
        publisher.put(Target(stamp_ns=time.time_ns(), signal=signal, values=np.asarray(values, float)))

    def enable(self) -> dict[str, Any]:
        """Ask the drives to follow commands; the answer tells the mode, which soon is `hold` or `fault`."""
        return self.ask("hal", "enable")

    def disable(self) -> dict[str, Any]:
        """Ask the drives to let go at once."""
        return self.ask("hal", "disable")

    def stop(self) -> dict[str, Any]:
        """Hold where the robot is, then disable."""
        return self.ask("hal", "stop")

    def reset(self) -> dict[str, Any]:
        """Leave a fault; never enables."""
        return self.ask("hal", "reset")

    def home(self, device: str) -> dict[str, Any]:
        """Ask one drive to find its zero, which moves it; the robot must be off, and its mode is then `homing`."""
        return self.ask("hal", "home", {"device": device})

    def tare(self, device: str) -> dict[str, Any]:
        """Ask one sensor to take what it measures as zero while the robot is off; its health tells what came of it."""
        return self.ask("hal", "tare", {"device": device})

    def estop(self, reason: str = "") -> dict[str, Any]:
        """Stop every drive as fast as it can, whatever the robot does; leave the fault with `reset`.

        Returns:
            `complete`: whether every drive stopped; `devices`: what each did (`device`, `stopped`, `text`); `text`:
            what else is wrong; `mode`. If it is not complete, or nobody answers, cut the power: this is no safety-rated
            emergency stop.
        """
        return self.ask("hal", "estop", {"reason": reason}, SLOW_TIMEOUT)

    def engage(self) -> dict[str, Any]:
        """Let the controller command the drives."""
        return self.ask("model", "engage")

    def disengage(self) -> dict[str, Any]:
        """Let the controller command no more."""
        return self.ask("model", "disengage")

    def adapt(self, active: bool) -> dict[str, Any]:
        """Start or stop the online update of the model."""
        return self.ask("model", "adapt", {"active": active}, SLOW_TIMEOUT)

    def rollback(self) -> dict[str, Any]:
        """Go back to the model before the online update."""
        return self.ask("model", "rollback", timeout=SLOW_TIMEOUT)

    def infer(
        self, signal: str, values: Mapping[str, Sequence[float] | np.ndarray] | None = None, hide: Iterable[str] = ()
    ) -> dict[str, Any]:
        """Ask the model for a signal, from given values or from the newest sample with some signals hidden."""
        return self.ask("model", "estimate", {"signal": signal, "hide": list(hide)} | _given(values), SLOW_TIMEOUT)

    def control(
        self,
        target: Mapping[str, Sequence[float] | np.ndarray],
        values: Mapping[str, Sequence[float] | np.ndarray] | None = None,
    ) -> dict[str, Any]:
        """Ask for the command that brings about a target, and what is expected of it; nothing moves.

        Args:
            target: Signal -> reference [its unit].
            values: Where the body is [its unit]; the newest sample if not given.
        """
        return self.ask("model", "control", {"target": _plain(target)} | _given(values), SLOW_TIMEOUT)

    def simulate(
        self,
        commands: Iterable[Sequence[float] | np.ndarray],
        given: Mapping[str, Sequence[float] | np.ndarray] | None = None,
        values: Mapping[str, Sequence[float] | np.ndarray] | None = None,
    ) -> dict[str, Any]:
        """Ask for the states that commands bring about one after the other; nothing moves.

        Args:
            commands: What is sent [unit of the commanded signal], each of shape (n,).
            given: References of the robot file's constraints that take one [its unit].
            values: Where the body is [its unit]; the newest sample if not given.
        """
        arguments = {"commands": [np.asarray(command, float).tolist() for command in commands]}
        return self.ask("model", "simulate", arguments | {"given": _plain(given or {})} | _given(values), LONG_TIMEOUT)

    def fault(self, text: str, service: str = "simulator") -> dict[str, Any]:
        """Break something in the simulator (`sensor_silent elbow_pitch_encoder`, `muscle_cut biceps`).

        Args:
            text: What to break.
            service: Who plays it: `simulator`, or `vision` for the camera (`camera_covered`).
        """
        return self.ask(service, "fault", {"text": text})

    def describe(self, service: str = "hal") -> dict[str, Any]:
        """Who a service is and what it serves."""
        return self.ask(service, "describe")

    def alive(self) -> set[str]:
        """Names of the robot's services that run now, as far as this client is connected."""
        return query.alive(self.session, self.robot)

    def ask(
        self, service: str, verb: str, arguments: Mapping[str, Any] | None = None, timeout: float = TIMEOUT
    ) -> dict[str, Any]:
        """Ask any verb of any service; see `query.ask`."""
        return query.ask(self.session, keys.verb(self.robot, service, verb), arguments, timeout)

    def reader(self, key: str, record: type[M]) -> Newest[M]:
        """The reader of a key, made when first asked for."""
        if key not in self._readers:
            self._readers[key] = Newest(self.session, key, record)
        return self._readers[key]

    def _publisher(self, key: str, record: type[M]) -> Publisher[M]:
        if key not in self._publishers:
            self._publishers[key] = Publisher(self.session, key, record, self.boot)
        return self._publishers[key]

    def _fresh(self, key: str, record: type[M], max_age: float, timeout: float) -> M | None:
        reader = self.reader(key, record)
        deadline = time.monotonic() + timeout
        while (message := reader.get(max_age)) is None and (remaining := deadline - time.monotonic()) > 0:
            reader.wait(remaining)
        return message


def _plain(values: Mapping[str, Sequence[float] | np.ndarray]) -> dict[str, list[float]]:
    return {name: np.asarray(value, float).tolist() for name, value in values.items()}


def _given(values: Mapping[str, Sequence[float] | np.ndarray] | None) -> dict[str, Any]:
    return {} if values is None else {"values": _plain(values)}
