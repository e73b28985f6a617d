"""A remote client in ten lines: read the newest of everything, ask for what a robot can do."""

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from hal.by_signal import Elements, Numbers, Truths
from services.client import description
from services.client.link import TIMEOUT
from services.client.listening import Listening
from services.client.live import FRESH
from services.command.client_lease import SECONDS, ClientLease
from services.errors import ServiceUnavailable
from services.wire import history, keys, query
from services.wire.history import History
from services.wire.messages import Anomaly, Command, Estimates, Sample, Target

SLOW_TIMEOUT = 10.0
"""Deadline [s] of a verb that computes."""
LONG_TIMEOUT = 60.0
"""Deadline [s] of a verb that computes step after step, or answers with much."""

Values = Mapping[str, Sequence[float] | np.ndarray]
"""Signal -> values [its unit], shape (n,)."""


class Client(Listening):
    """Reads a robot and asks it, from any process; needs no robot file, and nothing of the robot's code.

        with Client("musashi_arm") as arm:
            for now in arm.estimates():
                print(now.values["joint_position"])

    Three ways to listen: `sample`, `estimate` and the like return what is newest, or None rather than something old;
    `sensors`, `estimates`, `anomalies` and `health` go on for ever and raise when nothing comes; verbs ask a service.

    Every call ends: verbs and iterators have deadlines. A verb raises what the service raised, as it would be raised
    there. Nobody there is `ServiceUnavailable`; a role that may not is `NotAllowed`; another version of the wire format
    is `WrongVersion`; somebody there who does not answer in time is `TooSlow`.

    Verbs and readers may be used from several threads, each iterator and `command` and `target` from one at a time.
    The client goes on by itself when a service or a router was away.

    Args:
        robot: The robot's name.
        connect: A router's endpoint, or the role file for it, for a robot on another machine.
        name: Who this is, for people; user, host and pid if not given.
    """

    def estimate(
        self,
        values: Values | None = None,
        hide: Iterable[str] = (),
        *,
        max_age: float = FRESH,
        timeout: float = 0.0,
    ) -> Estimates | None:
        """The newest estimate of every signal, or None; see `sample`.

        With values, or with signals to hide, the model estimates from those instead, as `gemuco.estimate` does.
        """
        hidden = list(hide)
        if values is None and not hidden:
            return self.fresh(keys.estimate(self.robot), Estimates, max_age, timeout)
        found = self.ask("model", "estimate", _given(values) | {"hide": hidden}, SLOW_TIMEOUT)
        signals: dict[str, dict[str, Any]] = found["signals"]
        elements = Elements.of({name: len(one["values"]) for name, one in signals.items()})
        return Estimates(
            cycle=found["cycle"],
            elements=elements,
            values=Numbers(_joined(signals, "values", float), elements),
            estimated=Truths(_joined(signals, "estimated", bool), elements),
            std=Numbers(_joined(signals, "std", float), elements),
            method={name: one["method"] for name, one in signals.items()},
            mask={name: one["mask"] for name, one in signals.items()},
            residual={name: one["residual"] for name, one in signals.items()},
        )

    def anomaly(
        self,
        values: Values | None = None,
        hide: Iterable[str] = (),
        *,
        max_age: float = FRESH,
        timeout: float = 0.0,
    ) -> Anomaly | None:
        """The newest anomaly score, or None; see `sample`.

        With values, or with signals to hide, the model judges those instead, as `gemuco.anomaly.score` does: one sample
        by itself, however long.
        """
        hidden = list(hide)
        if values is None and not hidden:
            return self.fresh(keys.anomaly(self.robot), Anomaly, max_age, timeout)
        found = self.ask("model", "anomaly", _given(values) | {"hide": hidden}, SLOW_TIMEOUT)
        contribution = Numbers.of(found["contribution"])
        names = ("cycle", "score", "threshold", "is_anomaly", "blamed")
        return Anomaly(contribution=contribution, **{name: found[name] for name in names})

    def command(self, signal: str, values: np.ndarray, answers: Sample) -> None:
        """Send desired values to the drives; the HAL follows while they are younger than the time to live.

        Args:
            signal: The commanded signal.
            values: Desired values [its unit], shape (n,).
            answers: The sample that the command was made from; its age is the command's age.

        Raises:
            LeaseLost: This client's lease was lost.
        """
        message = Command(
            stamp_ns=time.time_ns(), signal=signal, values=np.asarray(values, float), cycle=answers.cycle,
            hal_boot=answers.boot, name=self.caller.name,
        )  # fmt: skip
        self.check_lease()
        self.publisher(keys.command(self.robot), Command).put(message)

    def target(self, signal: str, values: Sequence[float] | np.ndarray, timeout: float = TIMEOUT) -> None:
        """Tell the controller where to bring the body; it moves only while engaged.

        Args:
            signal: Signal to reach, such as `joint_position`.
            values: Reference [its unit], shape (n,).
            timeout: How long [s] to wait for a model service that listens.

        Raises:
            ServiceUnavailable: None listens.
        """
        publisher = self.publisher(keys.target(self.robot), Target)
        deadline = time.monotonic() + timeout
        while not publisher.has_listener:
            if time.monotonic() > deadline:
                raise ServiceUnavailable(
                    f"No 'model' service of robot '{self.robot}' takes targets. Is `gemuco serve` running?"
                )
            time.sleep(query.RETRY_AFTER)
        hal_boot, cycle = self.seen()
        self.check_lease()
        publisher.put(
            Target(
                stamp_ns=time.time_ns(), signal=signal, values=np.asarray(values, float), cycle=cycle, hal_boot=hal_boot
            )
        )

    def lease(self, seconds: float = SECONDS) -> ClientLease:
        """Command the robot, and nobody else, as a context manager.

            with arm.lease():
                arm.enable()

        Entering raises `CommandHeld`, which names the holder, while somebody else commands. After the lease was lost
        (this process was frozen, the HAL restarted) commands and verbs that need it raise `LeaseLost`. Everybody may
        still stop the robot.

        Args:
            seconds: How long the lease outlives this process; it is renewed in the background.
        """
        return ClientLease(self, seconds)

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

    def infer(self, signal: str, values: Values | None = None, hide: Iterable[str] = ()) -> dict[str, Any]:
        """Ask the model for a signal, from given values or from the newest sample with some signals hidden."""
        return self.ask("model", "estimate", {"signal": signal, "hide": list(hide)} | _given(values), SLOW_TIMEOUT)

    def control(
        self,
        target: Values,
        values: Values | None = None,
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
        given: Values | None = None,
        values: Values | None = None,
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

    def history(self, seconds: float, signals: Iterable[str] | None = None, timeout: float = SLOW_TIMEOUT) -> History:
        """What was estimated in the last seconds, from the model service's memory of one minute.

        Args:
            seconds: How far back [s].
            signals: Which; all if not given.
            timeout: Deadline [s].
        """
        names = () if signals is None else (signals,) if isinstance(signals, str) else tuple(signals)
        return history.fetch(lambda given, left: self.ask("model", "history", given, left), seconds, names, timeout)

    def describe(self, service: str = "", timeout: float = TIMEOUT) -> dict[str, Any]:
        """What this robot is, or who one of its services is and what it serves.

        Without a service: `signals` (unit, elements, source), `x_in`, `x_out`, `masks`, `conditions`, `rates`,
        `limits`, `command`, `controls`, `devices`, `versions`, `services` that are alive, and `missing`: what could not
        be told, because the service that knows it is away.
        """
        return self.ask(service, "describe", timeout=timeout) if service else description.of(self, timeout)


def _plain(values: Values) -> dict[str, list[float]]:
    return {name: np.asarray(value, float).tolist() for name, value in values.items()}


def _joined(signals: dict[str, dict[str, Any]], what: str, kind: type) -> np.ndarray:
    """What an answer tells of each signal's elements, in one array."""
    return np.array([number for one in signals.values() for number in one[what]], kind)


def _given(values: Values | None) -> dict[str, Any]:
    return {} if values is None else {"values": _plain(values)}
