"""Remote client of a robot: its newest messages, its services' verbs, its lease."""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
import zenoh

from hal.by_signal import Elements, Numbers, Truths
from services.client import description
from services.client.link import TIMEOUT, Link
from services.client.live import DEADLINE, FRESH, FRESH_STATUS, Health, Live, LiveHealth
from services.command.client_lease import SECONDS, ClientLease
from services.errors import ServiceUnavailable
from services.wire import history, keys, query
from services.wire.history import History
from services.wire.messages import (
    Anomaly,
    Applied,
    Command,
    Estimates,
    Holder,
    Message,
    Sample,
    Status,
    Target,
    Update,
)  # fmt: skip
from services.wire.streams import Reader

M = TypeVar("M", bound=Message)

SLOW_TIMEOUT = 10.0
"""A verb that computes has this deadline [s]."""
LONG_TIMEOUT = 60.0
"""A verb that computes many steps, or has a long answer, has this deadline [s]."""

Values = Mapping[str, Sequence[float] | np.ndarray]
"""Values map a signal to numbers [its unit], shape (n,)."""


class Client:
    """Client of a robot, for any process; it needs neither the robot file nor the robot's code.

        with Client("musashi_arm") as arm:
            for now in arm.estimates():
                print(now.values["joint_position"])

    `sample`, `estimate` and similar methods return the newest message, or None if that message is old. `sensors`,
    `estimates`, `anomalies` and `health` iterate without end, and raise an error if no message arrives. Verbs query a
    service.

    Every call ends: verbs and iterators have deadlines. A verb raises the service's error, with the same class. The
    error is `ServiceUnavailable` without a service, `NotAllowed` for a role without the right, `WrongVersion` for
    another version of the wire format, and `TooSlow` for a service that does not answer in time.

    Verbs and readers may be used from several threads; each iterator, `command` and `target` from one thread at a time.
    The client continues by itself after a service or a router was absent.

    Args:
        robot: The robot's name.
        connect: A router's endpoint, or the role file for it, for a robot on another machine.
        name: Name of this client for people; user, host and pid if not given.
    """

    def __init__(self, robot: str, connect: Iterable[str] = (), name: str = "") -> None:
        self.robot = robot
        self._link = Link(robot, connect, name)

    def __enter__(self) -> Self:
        self._link.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._link.close()

    def close(self) -> None:
        """End the session and its threads; a thread that waits gets an error. Safe to call twice."""
        self._link.close()

    @property
    def session(self) -> zenoh.Session:
        """Open zenoh session.

        Raises:
            ServiceError: The client is not open.
        """
        return self._link.session

    @property
    def boot(self) -> int:
        """Number that marks the messages of this client."""
        return self._link.boot

    def alive(self) -> set[str]:
        """Return the names of the robot's services that run now, as far as this client is connected."""
        return self._link.alive()

    def reader(self, key: str, record: type[M]) -> Reader[M]:
        """Return the reader of a key, made at the first call.

        Raises:
            NotAllowed: This client's role may not read the key.
        """
        return self._link.reader(key, record)

    def ask(
        self, service: str, verb: str, arguments: Mapping[str, Any] | None = None, timeout: float = TIMEOUT
    ) -> dict[str, Any]:
        """Query any verb of any service, as `query.ask`.

        Raises:
            NotAllowed: This client's role may not query the verb.
            CommandHeld: Another client commands the robot, and the verb needs the lease.
            LeaseLost: This client's lease was lost, and the verb needs it.
        """
        return self._link.ask(service, verb, arguments, timeout)

    # Messages: the newest, or None.

    def sample(self, max_age: float = FRESH, timeout: float = 0.0) -> Sample | None:
        """Return the newest measurement; None if none arrived in the last `max_age` [s] or within `timeout` [s]."""
        return self._link.fresh(keys.sample(self.robot), Sample, max_age, timeout)

    def next_sample(self, timeout: float = TIMEOUT) -> Sample | None:
        """Wait for the next measurement; None if none arrives within `timeout` [s]."""
        return self.reader(keys.sample(self.robot), Sample).wait(timeout)

    def vision(self, max_age: float = FRESH, timeout: float = 0.0) -> Sample | None:
        """Return the newest measurement of a camera, or None, like `sample`."""
        return self._link.fresh(keys.vision(self.robot), Sample, max_age, timeout)

    def applied(self, max_age: float = FRESH, timeout: float = 0.0) -> Applied | None:
        """Return the command last sent to the drives, or None, like `sample`."""
        return self._link.fresh(keys.applied(self.robot), Applied, max_age, timeout)

    def update(self, max_age: float = 4 * FRESH, timeout: float = 0.0) -> Update | None:
        """Return the newest state of the online update, or None, like `sample`."""
        return self._link.fresh(keys.update(self.robot), Update, max_age, timeout)

    def truth(self, max_age: float = FRESH, timeout: float = 0.0) -> Sample | None:
        """Return the newest truth of a simulator, or None, like `sample`."""
        return self._link.fresh(keys.truth(self.robot), Sample, max_age, timeout)

    def status(self, service: str, max_age: float = FRESH_STATUS, timeout: float = 0.0) -> Status | None:
        """Return the newest status of a service, or None, like `sample`."""
        return self._link.fresh(keys.status(self.robot, service), Status, max_age, timeout)

    def holder(self, timeout: float = TIMEOUT) -> Holder:
        """Return the lease holder; its `name` is empty without one.

        Raises:
            ServiceUnavailable: No HAL publishes the holder.
        """
        key = keys.holder(self.robot)
        holder = self._link.fresh(key, Holder, FRESH_STATUS, timeout)
        if holder is None:
            raise self._link.silence(self.reader(key, Holder), timeout)
        return holder

    def estimate(
        self, values: Values | None = None, hide: Iterable[str] = (), *, max_age: float = FRESH, timeout: float = 0.0
    ) -> Estimates | None:
        """Return the newest estimate of every signal, or None, like `sample`.

        With `values` or `hide` the model service estimates anew, as `gemuco.estimate` does.
        """
        hidden = list(hide)
        if values is None and not hidden:
            return self._link.fresh(keys.estimate(self.robot), Estimates, max_age, timeout)
        answer = self.ask("model", "estimate", _values_argument(values) | {"hide": hidden}, SLOW_TIMEOUT)
        signals: dict[str, dict[str, Any]] = answer["signals"]
        elements = Elements.of({name: len(part["values"]) for name, part in signals.items()})
        return Estimates(
            cycle=answer["cycle"],
            elements=elements,
            values=Numbers(_joined(signals, "values", float), elements),
            estimated=Truths(_joined(signals, "estimated", bool), elements),
            std=Numbers(_joined(signals, "std", float), elements),
            method={name: part["method"] for name, part in signals.items()},
            mask={name: part["mask"] for name, part in signals.items()},
            residual={name: part["residual"] for name, part in signals.items()},
            state={name: part["state"] for name, part in signals.items() if "state" in part},
            reason={name: part["reason"] for name, part in signals.items() if part.get("reason")},
            distrusted=answer.get("distrusted", {}),
        )

    def anomaly(
        self, values: Values | None = None, hide: Iterable[str] = (), *, max_age: float = FRESH, timeout: float = 0.0
    ) -> Anomaly | None:
        """Return the newest anomaly score, or None, like `sample`.

        With `values` or `hide` the model service scores this single sample anew, as `gemuco.score` does.
        """
        hidden = list(hide)
        if values is None and not hidden:
            return self._link.fresh(keys.anomaly(self.robot), Anomaly, max_age, timeout)
        answer = self.ask("model", "anomaly", _values_argument(values) | {"hide": hidden}, SLOW_TIMEOUT)
        contribution = Numbers.of(answer["contribution"])
        names = ("cycle", "score", "threshold", "is_anomaly", "blamed")
        return Anomaly(contribution=contribution, **{name: answer[name] for name in names})

    # Iterators: always the newest message.

    def sensors(self, service: str = "hal", deadline: float | None = DEADLINE) -> Iterator[Sample]:
        """Return an iterator over measurements, always the newest; a slow caller skips some.

        Args:
            service: `hal`, or `vision` for a camera.
            deadline: Longest wait for a measurement [s]; None waits without end.

        Raises:
            ServiceUnavailable, TooSlow, WrongVersion: `next` found no measurement in time; it may be called again.
            NotAllowed: This client's role may not read the measurements.
        """
        key = keys.vision(self.robot) if service == "vision" else keys.sample(self.robot)
        return self._live(key, Sample, deadline)

    def estimates(self, deadline: float | None = DEADLINE) -> Iterator[Estimates]:
        """Return an iterator over estimates of every signal, like `sensors`."""
        return self._live(keys.estimate(self.robot), Estimates, deadline)

    def anomalies(self, deadline: float | None = DEADLINE) -> Iterator[Anomaly]:
        """Return an iterator over anomaly scores, like `sensors`."""
        return self._live(keys.anomaly(self.robot), Anomaly, deadline)

    def health(self, deadline: float | None = DEADLINE) -> Iterator[Health]:
        """Return an iterator over the health of the robot's services, after every change and status, like `sensors`."""
        link = self._link
        readers = [self.reader(keys.status(self.robot, service), Status) for service in keys.SERVICES]
        return LiveHealth(
            link.presence(), readers, link.changed, deadline, lambda waited: link.no_health(readers, waited)
        )

    def _live(self, key: str, record: type[M], deadline: float | None) -> Live[M]:
        reader = self.reader(key, record)
        return Live(reader, deadline, FRESH, lambda waited: self._link.silence(reader, waited))

    # Commands.

    def command(self, signal: str, values: np.ndarray, answers: Sample) -> None:
        """Send desired values to the drives; the HAL follows them until their time to live has passed.

        Args:
            signal: The commanded signal.
            values: Desired values [its unit], shape (n,).
            answers: The sample from which the command was computed; its age is the command's age.

        Raises:
            LeaseLost: This client's lease was lost.
        """
        message = Command(
            stamp_ns=time.time_ns(), signal=signal, values=np.asarray(values, float), cycle=answers.cycle,
            hal_boot=answers.boot, name=self._link.caller.name,
        )  # fmt: skip
        self._link.check_lease()
        self._link.publisher(keys.command(self.robot), Command).put(message)

    def target(self, signal: str, values: Sequence[float] | np.ndarray, timeout: float = TIMEOUT) -> None:
        """Send a target to the controller; the robot moves only while engaged.

        Args:
            signal: Signal to reach, such as `joint_position`.
            values: Reference [its unit], shape (n,).
            timeout: Longest wait for a model service that takes targets [s].

        Raises:
            ServiceUnavailable: No model service takes targets.
        """
        publisher = self._link.publisher(keys.target(self.robot), Target)
        deadline = time.monotonic() + timeout
        while not publisher.has_listener:
            if time.monotonic() > deadline:
                raise ServiceUnavailable(
                    f"No 'model' service of robot '{self.robot}' takes targets. Is `gemuco serve` running?"
                )
            time.sleep(query.RETRY_AFTER)
        hal_boot, cycle = self._link.seen()
        self._link.check_lease()
        publisher.put(
            Target(
                stamp_ns=time.time_ns(), signal=signal, values=np.asarray(values, float), cycle=cycle, hal_boot=hal_boot
            )
        )

    def lease(self, seconds: float = SECONDS) -> ClientLease:
        """Return a context manager in which only this client commands the robot.

            with arm.lease():
                arm.enable()

        Entering raises `CommandHeld`, which names the holder, while another client commands. If the lease is lost
        (this process was frozen, or the HAL was restarted), commands and verbs that need the lease raise `LeaseLost`.
        Every client may still stop the robot.

        Args:
            seconds: Length of the lease [s], which is renewed in the background.
        """
        return ClientLease(self._link, seconds)

    # Verbs of the HAL.

    def enable(self) -> dict[str, Any]:
        """Enable the drives, which then follow commands; the answer has the mode, which soon is `hold` or `fault`."""
        return self.ask("hal", "enable")

    def disable(self) -> dict[str, Any]:
        """Disable the drives at once."""
        return self.ask("hal", "disable")

    def stop(self) -> dict[str, Any]:
        """Hold the present position, then disable."""
        return self.ask("hal", "stop")

    def reset(self) -> dict[str, Any]:
        """Leave a fault; the drives stay disabled."""
        return self.ask("hal", "reset")

    def home(self, device: str) -> dict[str, Any]:
        """Let a drive move and search its zero; the robot must be off, and its mode is then `homing`."""
        return self.ask("hal", "home", {"device": device})

    def tare(self, device: str) -> dict[str, Any]:
        """Set a sensor's zero to its present reading while the robot is off; the sensor's health has the result."""
        return self.ask("hal", "tare", {"device": device})

    def estop(self, reason: str = "") -> dict[str, Any]:
        """Stop every drive as fast as possible, in every mode; leave the fault with `reset`.

        Returns:
            `complete`: whether every drive stopped; `devices`: the result of each (`device`, `stopped`, `text`);
            `text`: other faults; `mode`. If `complete` is false, or no HAL answers, cut the power: this is not a
            safety-rated emergency stop.
        """
        return self.ask("hal", "estop", {"reason": reason}, SLOW_TIMEOUT)

    # Verbs of the model.

    def engage(self) -> dict[str, Any]:
        """Let the controller command the drives."""
        return self.ask("model", "engage")

    def disengage(self) -> dict[str, Any]:
        """End the controller's commands."""
        return self.ask("model", "disengage")

    def adapt(self, active: bool) -> dict[str, Any]:
        """Start or stop the online update of the model."""
        return self.ask("model", "adapt", {"active": active}, SLOW_TIMEOUT)

    def rollback(self) -> dict[str, Any]:
        """Return to the model before the online update."""
        return self.ask("model", "rollback", timeout=SLOW_TIMEOUT)

    def learn_normal(self) -> dict[str, Any]:
        """Learn the normal errors from the samples since the model last changed; return `samples`, their number."""
        return self.ask("model", "normal", timeout=SLOW_TIMEOUT)

    def trust(self, element: str) -> dict[str, Any]:
        """Let the model use an element (`joint_position.elbow_pitch`) as measured again; return what is distrusted."""
        return self.ask("model", "trust", {"element": element})

    def distrust(self, element: str) -> dict[str, Any]:
        """Hide an element from the model, which then estimates it, until `trust`; return what is distrusted."""
        return self.ask("model", "distrust", {"element": element})

    def infer(self, signal: str, values: Values | None = None, hide: Iterable[str] = ()) -> dict[str, Any]:
        """Query the model for a signal, from `values` or from the newest sample, with some signals hidden."""
        return self.ask(
            "model", "estimate", {"signal": signal, "hide": list(hide)} | _values_argument(values), SLOW_TIMEOUT
        )

    def control(self, target: Values, values: Values | None = None) -> dict[str, Any]:
        """Query the command that reaches a target, and its expected result; the robot does not move.

        Args:
            target: Signal -> reference [its unit].
            values: Present state of the body [its unit]; the newest sample if not given.
        """
        return self.ask("model", "control", {"target": _plain(target)} | _values_argument(values), SLOW_TIMEOUT)

    def simulate(
        self,
        commands: Iterable[Sequence[float] | np.ndarray],
        given: Values | None = None,
        values: Values | None = None,
    ) -> dict[str, Any]:
        """Query the states after successive commands; the robot does not move.

        Args:
            commands: Commands [unit of the commanded signal], each of shape (n,).
            given: References of the constraints in the robot file that have a reference [its unit].
            values: Present state of the body [its unit]; the newest sample if not given.
        """
        arguments = {"commands": [np.asarray(command, float).tolist() for command in commands]}
        return self.ask(
            "model", "simulate", arguments | {"given": _plain(given or {})} | _values_argument(values), LONG_TIMEOUT
        )

    def history(self, seconds: float, signals: Iterable[str] | None = None, timeout: float = SLOW_TIMEOUT) -> History:
        """Return the estimates of the last seconds, of at most one minute, from the model service's memory.

        Args:
            seconds: Length of time [s].
            signals: Names of signals; all if not given.
            timeout: Deadline [s].
        """
        names = () if signals is None else (signals,) if isinstance(signals, str) else tuple(signals)
        return history.fetch(lambda given, left: self.ask("model", "history", given, left), seconds, names, timeout)

    # Verbs of every service.

    def fault(self, text: str, service: str = "simulator") -> dict[str, Any]:
        """Break a part of the simulated robot (`sensor_silent elbow_pitch_encoder`, `muscle_cut biceps`).

        Args:
            text: The fault.
            service: `simulator`, or `vision` for the camera (`camera_covered`).
        """
        return self.ask(service, "fault", {"text": text})

    def describe(self, service: str = "", timeout: float = TIMEOUT) -> dict[str, Any]:
        """Return a description of the robot, or of one of its services.

        Without a service: `signals` (unit, elements, source), `x_in`, `x_out`, `masks`, `conditions`, `rates`,
        `limits`, `command`, `controls`, `devices`, `versions`, live `services`, and the `missing` parts of absent
        services.
        """
        return self.ask(service, "describe", timeout=timeout) if service else description.of(self._link, timeout)


def _plain(values: Values) -> dict[str, list[float]]:
    return {name: np.asarray(value, float).tolist() for name, value in values.items()}


def _joined(signals: dict[str, dict[str, Any]], field: str, kind: type) -> np.ndarray:
    """Return a field of all signals of an answer in one array."""
    return np.array([number for part in signals.values() for number in part[field]], kind)


def _values_argument(values: Values | None) -> dict[str, Any]:
    return {} if values is None else {"values": _plain(values)}
