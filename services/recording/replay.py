"""The process that plays a recording on its own clock, in place of the HAL and the camera.

What it publishes has the recorded content and new stamps, a new `boot` for each recorded one, and the source `replay`:
nobody can take it for a robot. Commands are never played, and it has no motors, so every verb that would move refuses.
"""

import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from msgspec.structs import replace

from hal.errors import CommandRefused
from services.errors import BadArguments, RecordingError
from services.process.service import Service, until_told
from services.recording.reading import About, Paths, Recorded, about, one_robot, read
from services.recording.writer import CARRIED
from services.wire import keys
from services.wire.records import Applied, Message, Sample, Status
from services.wire.session import new_boot
from services.wire.streams import Publisher

log = logging.getLogger(__name__)

SOURCE = "replay"
MEASURED = ("hal/sample", "hal/applied", "vision/sample")
THOUGHT = ("model/estimate", "model/anomaly", "model/update")
LATE = 0.005
"""A message that is published so long [s] after its time counts as late."""
LONGEST_PAUSE = 10.0
"""A longer pause in the recordings [s] is cut to one second."""
MOST_STEPS = 100_000
MOVES = ("enable", "disable", "home", "tare", "reset", "stop", "estop", "lease", "release")
"""Verbs of a HAL that a replay refuses."""


@dataclass(slots=True)
class Played:
    """How far a replay is.

    Attributes:
        messages: How many were published.
        samples: Of those, samples of the HAL.
        reached: How much of the recordings' time [s] lies behind.
        late: How many were published more than `LATE` after their time.
        latest: The most that one was late [s].
        pauses: Pauses that were cut short.
    """

    messages: int = 0
    samples: int = 0
    reached: float = 0.0
    late: int = 0
    latest: float = 0.0
    pauses: int = 0


class Pace:
    """When each message is due: on an absolute grid, the recorded times divided by the speed."""

    def __init__(self, speed: float, stop: threading.Event, played: Played) -> None:
        self._speed, self._stop, self._played = speed, stop, played
        self._begun = time.monotonic()
        self._begun_ns = time.time_ns()
        self._last_ns: int | None = None
        self._elapsed = 0.0
        self._cut_ns = 0

    def wait(self, received_ns: int) -> bool:
        """Wait until a message that arrived then is due; False if the replay was told to end."""
        self._pass(received_ns)
        wait = self._begun + self._elapsed / self._speed - time.monotonic()
        if wait > 0.0 and self._stop.wait(wait):
            return False
        late = -wait if wait < 0.0 else 0.0
        self._played.late += late > LATE
        self._played.latest = max(self._played.latest, late)
        return not self._stop.is_set()

    def stamp_ns(self, recorded_ns: int, received_ns: int) -> int:
        """The new stamp of a message: as long before it is due as the recorded one was before its arrival."""
        on_the_way = (received_ns - recorded_ns) / self._speed
        return self._begun_ns + round(1e9 * self._elapsed / self._speed - on_the_way)

    def _pass(self, received_ns: int) -> None:
        if self._last_ns is not None:
            step = max(received_ns - self._last_ns, 0) * 1e-9
            if step > LONGEST_PAUSE:
                self._played.pauses += 1
                step = 1.0
            self._elapsed += step
        self._last_ns = received_ns
        self._played.reached = self._elapsed


class Steps:
    """When somebody asks for it: so many samples of the HAL, and all that lies between them."""

    def __init__(self, stop: threading.Event, played: Played) -> None:
        self._stop, self._played = stop, played
        self._changed = threading.Condition()
        self._allowed = 0
        self._first_ns: int | None = None

    def allow(self, count: int, within: float) -> None:
        """Let so many samples more be played, and wait until they are; at most so long [s]."""
        with self._changed:
            self._allowed = self._played.samples + count
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_done() or self._stop.is_set(), within)

    def wait(self, received_ns: int) -> bool:
        """Wait until the next message may be published; False if the replay was told to end."""
        with self._changed:
            self._changed.notify_all()
            while self._is_done() and not self._stop.is_set():
                self._changed.wait(0.1)
        first = self._first_ns = self._first_ns or received_ns
        self._played.reached = (received_ns - first) * 1e-9
        return not self._stop.is_set()

    def stamp_ns(self, recorded_ns: int, received_ns: int) -> int:
        """The new stamp of a message: now."""
        return time.time_ns()

    def end(self) -> None:
        """Let go whoever waits; the replay has ended."""
        with self._changed:
            self._changed.notify_all()

    def _is_done(self) -> bool:
        return self._played.samples >= self._allowed


class Replay:
    """Plays recordings on the sessions of the services that it stands in for.

    Args:
        services: By name; `hal` is among them.
        files: What is played.
        messages: Its messages in order.
        speed: Times the recorded speed; 0 plays only what is asked for with `hal/do/step`.
        stop: Ends the replay; set when there is nothing left to play.
    """

    def __init__(
        self,
        services: dict[str, Service],
        files: Sequence[About],
        messages: Iterator[Recorded],
        speed: float,
        stop: threading.Event,
    ) -> None:
        self.played = Played()
        self._services, self._files, self._messages, self._speed, self._stop = services, files, messages, speed, stop
        self._steps = Steps(stop, self.played) if speed == 0.0 else None
        self._publishers: dict[tuple[str, int], Publisher[Any]] = {}
        self._boots: dict[int, int] = {}
        self._mode = ""
        self._failure = ""
        hal = services["hal"]
        for verb in MOVES:
            hal.verb(verb, _refuse(verb), always=True)
        if self._steps is not None:
            hal.verb("step", self._step)

    @property
    def length(self) -> float:
        """How much time the files cover [s], the pauses between them included."""
        return (max(one.end_ns for one in self._files) - min(one.begin_ns for one in self._files)) * 1e-9

    def run(self) -> None:
        """Play until the end, or until told to end."""
        playing = threading.Thread(target=self._play, name="replay", daemon=True)
        playing.start()
        try:
            self._services["hal"].run(self._statuses, self._stop)
        finally:
            self._stop.set()
            playing.join()
        if self._failure:
            raise RecordingError(self._failure)

    def summary(self) -> str:
        """What was played, in a sentence."""
        played = self.played
        text = f"{played.messages} messages of {played.reached:.1f} s were played"
        if played.late:
            text += f", {played.late} of them late by more than {1e3 * LATE:g} ms, {1e3 * played.latest:.0f} at most"
        return text + (f"; {played.pauses} long pauses were cut to 1 s." if played.pauses else ".")

    def _play(self) -> None:
        try:
            pace = self._steps or Pace(self._speed, self._stop, self.played)
            for one in self._messages:
                if not pace.wait(one.received_ns):
                    return
                self._publish(one, pace.stamp_ns(one.message.stamp_ns, one.received_ns))
        except RecordingError as error:
            self._failure = str(error)
        finally:
            self._stop.set()
            if self._steps is not None:
                self._steps.end()

    def _publish(self, one: Recorded, stamp_ns: int) -> None:
        noun = _noun(one.key)
        boot = one.message.boot
        if (noun, boot) not in self._publishers:
            service = self._services[noun.partition("/")[0]]
            key = keys.robot_key(service.robot, noun)
            # What was restarted while it was recorded looks restarted again; two boots are never told apart by chance.
            new = self._boots.setdefault(boot, service.boot if not self._boots else new_boot())
            self._publishers[noun, boot] = Publisher(service.session, key, CARRIED[noun], new)
        message: Message = replace(one.message, stamp_ns=stamp_ns)
        if isinstance(message, Sample):
            message = replace(message, source=SOURCE)
        elif isinstance(message, Applied):
            message = replace(message, sender=0)
            self._mode = message.mode
        self._publishers[noun, boot].put(message)
        self.played.messages += 1
        self.played.samples += noun == MEASURED[0]

    def _step(self, given: dict[str, Any]) -> dict[str, Any]:
        assert self._steps is not None
        count = given.get("count", 1)
        is_number = isinstance(count, int) and not isinstance(count, bool)
        if set(given) - {"count"} or not is_number or not 1 <= count <= MOST_STEPS:
            raise BadArguments(f"step takes {{count: 1 to {MOST_STEPS}}}, the number of samples to play.")
        self._steps.allow(count, within=1.0)
        return {"samples": self.played.samples, "reached": self.played.reached, "ended": self._stop.is_set()}

    def _statuses(self) -> Status:
        for name, service in self._services.items():
            if name != "hal":
                service.publish_status(lambda name=name: self._status(name))  # type: ignore[misc]
        return self._status("hal")

    def _status(self, name: str) -> Status:
        played = self.played
        how = "step by step" if self._speed == 0.0 else f"at {self._speed:g} x"
        text = f"A replay {how}, no robot: {played.reached:.1f} of {self.length:.1f} s."
        facts: dict[str, Any] = {
            "replay": {
                "files": [one.path.name for one in self._files],
                "speed": self._speed,
                **{field: getattr(played, field) for field in Played.__slots__},
            }
        }
        if name == "hal":
            facts |= {"mode": self._mode, "fault": "", "buses": {}, "devices": {}, "camera": "vision" in self._services}
        return Status(stamp_ns=time.time_ns(), service=name, state="running", text=text, facts=facts)


def run_replay(
    paths: Paths,
    robot: str | None = None,
    speed: float = 1.0,
    with_model: bool = False,
    connect: Iterable[str] = (),
    stop: threading.Event | None = None,
) -> int:
    """Play recordings in place of a robot's HAL, and of its camera where it has one, until their end.

    Args:
        paths: Recordings of one robot, in any order.
        robot: The name to play under; the recorded robot's if None.
        speed: Times the recorded speed; 0 plays only what is asked for with `hal/do/step`.
        with_model: Play what the model published too, in its place.
        connect: Endpoints, such as a router's, and role files.
        stop: Ends the replay in place of the signals.

    Returns:
        The process's exit code.

    Raises:
        RecordingError: The files cannot be played.
        AlreadyRunning: The robot has a HAL, or another service that is played.
        ServiceError: No session.
    """
    if not (math.isfinite(speed) and speed >= 0.0):
        raise RecordingError(
            f"A recording cannot be played at {speed:g} times its speed; 1 is as recorded, 0 by steps."
        )
    files = about(paths)
    recorded = one_robot(files)
    wanted = [keys.robot_key(recorded, noun) for noun in (*MEASURED, *(THOUGHT if with_model else ()))]
    found = _held(files, wanted)
    if not found:
        raise RecordingError(f"There is nothing of robot '{recorded}' to play: no {', '.join(wanted[:3])}.")
    names = ["hal", *sorted({noun.partition("/")[0] for noun in map(_noun, found)} - {"hal"})]
    with until_told(stop) as told, contextlib.ExitStack() as stack:
        services = {
            name: stack.enter_context(Service(robot or recorded, name, connect, lambda: _describe(files)))
            for name in names
        }
        played = Replay(services, files, read([one.path for one in files], wanted), speed, told)
        played.run()
        for name in names[1:]:
            services[name].publish_status(_ended(name))
    print(played.summary())
    return 0


def _held(files: Sequence[About], wanted: Iterable[str]) -> set[str]:
    """Which of some keys the files hold."""
    known = set().union(*(one.keys for one in files))
    return known & set(wanted)


def _noun(key: str) -> str:
    _, service, rest = keys.parse(key)
    return f"{service}/{rest}"


def _describe(files: Sequence[About]) -> dict[str, Any]:
    own = ("robot", "service", "boot", "package")
    told = {name: value for name, value in files[-1].described.items() if name not in own}
    return told | {"replay": [one.path.name for one in files]}


def _refuse(verb: str) -> Callable[[dict[str, Any]], Any]:
    def refuse(_: dict[str, Any]) -> Any:
        text = f"This is a replay of a recording: it has no motors and cannot '{verb}'."
        if verb in ("stop", "estop", "disable"):
            text += " If a robot moves, it is not this program that moves it: cut its power."
        raise CommandRefused(text)

    return refuse


def _ended(name: str) -> Callable[[], Status]:
    return lambda: Status(stamp_ns=time.time_ns(), service=name, state="stopping")
