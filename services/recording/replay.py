"""Process that plays a recording on its own clock, in place of the HAL and the camera.

The messages have the recorded content, new stamps, a new `boot` for each recorded `boot`, and the source `replay`, so
that no client mistakes them for a robot's. Commands are never played. Every verb that moves a robot is refused.
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
from services.process.service import Service, until_stopped
from services.recording.reading import FileFacts, Paths, Recorded, facts_of, one_robot, read
from services.recording.writer import CARRIED
from services.wire import keys
from services.wire.records import Applied, Message, Sample, Status
from services.wire.session import new_boot
from services.wire.streams import Publisher

log = logging.getLogger(__name__)

SOURCE = "replay"
MEASURED = ("hal/sample", "hal/applied", "vision/sample")
INFERRED = ("model/estimate", "model/anomaly", "model/update")
LATE = 0.005
"""A message that is published more than this [s] after its time counts as late."""
LONGEST_PAUSE = 10.0
"""A pause in the recordings that is longer than this [s] is cut to one second."""
MOST_STEPS = 100_000
MOVES = ("enable", "disable", "home", "tare", "reset", "stop", "estop", "lease", "release")
"""A replay refuses these verbs of a HAL."""


@dataclass(slots=True)
class ReplayCounts:
    """Counts of a replay so far.

    Attributes:
        messages: Published messages.
        samples: Published samples of the HAL.
        reached: Played time of the recordings [s].
        late: Messages published more than `LATE` after their time.
        latest: Largest lateness [s].
        pauses: Pauses that were cut to one second.
    """

    messages: int = 0
    samples: int = 0
    reached: float = 0.0
    late: int = 0
    latest: float = 0.0
    pauses: int = 0


class TimedSchedule:
    """Schedule on an absolute grid: recorded times divided by the speed."""

    def __init__(self, speed: float, stop: threading.Event, counts: ReplayCounts) -> None:
        self._speed, self._stop, self._counts = speed, stop, counts
        self._begun = time.monotonic()
        self._begun_ns = time.time_ns()
        self._last_ns: int | None = None
        self._elapsed = 0.0

    def wait(self, received_ns: int) -> bool:
        """Wait until the message with this arrival is due; return False if the replay was stopped."""
        self._advance(received_ns)
        wait = self._begun + self._elapsed / self._speed - time.monotonic()
        if wait > 0.0 and self._stop.wait(wait):
            return False
        late = -wait if wait < 0.0 else 0.0
        self._counts.late += late > LATE
        self._counts.latest = max(self._counts.latest, late)
        return not self._stop.is_set()

    def stamp_ns(self, recorded_ns: int, received_ns: int) -> int:
        """Return the new stamp of a message [ns]; its transit, divided by the speed, stays the same."""
        transit_ns = (received_ns - recorded_ns) / self._speed
        return self._begun_ns + round(1e9 * self._elapsed / self._speed - transit_ns)

    def _advance(self, received_ns: int) -> None:
        if self._last_ns is not None:
            step = max(received_ns - self._last_ns, 0) * 1e-9
            if step > LONGEST_PAUSE:
                self._counts.pauses += 1
                step = 1.0
            self._elapsed += step
        self._last_ns = received_ns
        self._counts.reached = self._elapsed


class SteppedSchedule:
    """Schedule on request: each request plays a number of the HAL's samples and all messages between them."""

    def __init__(self, stop: threading.Event, counts: ReplayCounts) -> None:
        self._stop, self._counts = stop, counts
        self._changed = threading.Condition()
        self._allowed = 0
        self._first_ns: int | None = None

    def allow(self, count: int, within: float) -> None:
        """Release `count` more samples and wait until they are played, at most `within` [s]."""
        with self._changed:
            self._allowed = self._counts.samples + count
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._is_waiting() or self._stop.is_set(), within)

    def wait(self, received_ns: int) -> bool:
        """Wait until the next message may be published; return False if the replay was stopped."""
        with self._changed:
            self._changed.notify_all()
            while self._is_waiting() and not self._stop.is_set():
                self._changed.wait(0.1)
        first = self._first_ns = self._first_ns or received_ns
        self._counts.reached = (received_ns - first) * 1e-9
        return not self._stop.is_set()

    def stamp_ns(self, recorded_ns: int, received_ns: int) -> int:
        """Return the present time as the new stamp of a message [ns]."""
        return time.time_ns()

    def end(self) -> None:
        """Wake all waiting threads; the replay has ended."""
        with self._changed:
            self._changed.notify_all()

    def _is_waiting(self) -> bool:
        return self._counts.samples >= self._allowed


class Replay:
    """Replay of recordings on the sessions of the replaced services.

    Args:
        services: Services by name; `hal` is among them.
        files: Facts of the played files.
        messages: Messages of the files in order.
        speed: Multiple of the recorded speed; 0 plays only on request by `hal/do/step`.
        stop: Event that ends the replay; the replay sets it after the last message.
    """

    def __init__(
        self,
        services: dict[str, Service],
        files: Sequence[FileFacts],
        messages: Iterator[Recorded],
        speed: float,
        stop: threading.Event,
    ) -> None:
        self.counts = ReplayCounts()
        self._services, self._files, self._messages, self._speed, self._stop = services, files, messages, speed, stop
        self._steps = SteppedSchedule(stop, self.counts) if speed == 0.0 else None
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
        """Time that the files cover, with the pauses between them [s]."""
        return (max(file.end_ns for file in self._files) - min(file.begin_ns for file in self._files)) * 1e-9

    def run(self) -> None:
        """Play until the end or until stopped."""
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
        """Return one sentence on the played messages."""
        counts = self.counts
        text = f"{counts.messages} messages of {counts.reached:.1f} s were played"
        if counts.late:
            text += f", {counts.late} of them more than {1e3 * LATE:g} ms late, at most {1e3 * counts.latest:.0f} ms"
        return text + (f"; {counts.pauses} long pauses were cut to 1 s." if counts.pauses else ".")

    def _play(self) -> None:
        try:
            schedule = self._steps or TimedSchedule(self._speed, self._stop, self.counts)
            for recorded in self._messages:
                if not schedule.wait(recorded.received_ns):
                    return
                self._publish(recorded, schedule.stamp_ns(recorded.message.stamp_ns, recorded.received_ns))
        except RecordingError as error:
            self._failure = str(error)
        finally:
            self._stop.set()
            if self._steps is not None:
                self._steps.end()

    def _publish(self, recorded: Recorded, stamp_ns: int) -> None:
        noun = _noun(recorded.key)
        boot = recorded.message.boot
        if (noun, boot) not in self._publishers:
            service = self._services[noun.partition("/")[0]]
            key = keys.robot_key(service.robot, noun)
            # A service that was restarted during the recording looks restarted again.
            new = self._boots.setdefault(boot, service.boot if not self._boots else new_boot())
            self._publishers[noun, boot] = Publisher(service.session, key, CARRIED[noun], new)
        message: Message = replace(recorded.message, stamp_ns=stamp_ns)
        if isinstance(message, Sample):
            message = replace(message, source=SOURCE)
        elif isinstance(message, Applied):
            message = replace(message, sender=0)
            self._mode = message.mode
        self._publishers[noun, boot].put(message)
        self.counts.messages += 1
        self.counts.samples += noun == MEASURED[0]

    def _step(self, arguments: dict[str, Any]) -> dict[str, Any]:
        assert self._steps is not None
        count = arguments.get("count", 1)
        is_number = isinstance(count, int) and not isinstance(count, bool)
        if set(arguments) - {"count"} or not is_number or not 1 <= count <= MOST_STEPS:
            raise BadArguments(f"step takes {{count: 1 to {MOST_STEPS}}}, the number of samples to play.")
        self._steps.allow(count, within=1.0)
        return {"samples": self.counts.samples, "reached": self.counts.reached, "ended": self._stop.is_set()}

    def _statuses(self) -> Status:
        for name, service in self._services.items():
            if name != "hal":
                service.publish_status(lambda name=name: self._status(name))  # type: ignore[misc]
        return self._status("hal")

    def _status(self, name: str) -> Status:
        counts = self.counts
        speed = "step by step" if self._speed == 0.0 else f"at {self._speed:g} x"
        text = f"A replay {speed}, not a robot: {counts.reached:.1f} of {self.length:.1f} s."
        facts: dict[str, Any] = {
            "replay": {
                "files": [file.path.name for file in self._files],
                "speed": self._speed,
                **{field: getattr(counts, field) for field in ReplayCounts.__slots__},
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
    """Play recordings to their end, in place of a robot's HAL and camera.

    Args:
        paths: Recordings of one robot, in any order.
        robot: Name of the robot in the replay; the recorded name if None.
        speed: Multiple of the recorded speed; 0 plays only on request by `hal/do/step`.
        with_model: Play also the messages of the model service, in place of it.
        connect: Endpoints, such as a router's, and role files.
        stop: Event that ends the replay, in place of SIGTERM and SIGINT.

    Returns:
        Exit code of the process.

    Raises:
        RecordingError: The files cannot be played.
        AlreadyRunning: The robot has a HAL, or another of the played services.
        ServiceError: No session could be opened.
    """
    if not (math.isfinite(speed) and speed >= 0.0):
        raise RecordingError(
            f"A recording cannot be played at {speed:g} times its speed; 1 is the recorded speed, 0 plays step by step."
        )
    files = facts_of(paths)
    recorded = one_robot(files)
    playable = [keys.robot_key(recorded, noun) for noun in (*MEASURED, *(INFERRED if with_model else ()))]
    recorded_keys = _held(files, playable)
    if not recorded_keys:
        raise RecordingError(f"There are no messages of robot '{recorded}' to play: no {', '.join(playable[:3])}.")
    names = ["hal", *sorted({noun.partition("/")[0] for noun in map(_noun, recorded_keys)} - {"hal"})]
    with until_stopped(stop) as stopped, contextlib.ExitStack() as stack:
        services = {
            name: stack.enter_context(Service(robot or recorded, name, connect, lambda: _describe(files)))
            for name in names
        }
        replay = Replay(services, files, read([file.path for file in files], playable), speed, stopped)
        replay.run()
        for name in names[1:]:
            services[name].publish_status(_ended(name))
    print(replay.summary())
    return 0


def _held(files: Sequence[FileFacts], candidates: Iterable[str]) -> set[str]:
    """Return the candidate keys that the files hold."""
    return set().union(*(file.keys for file in files)) & set(candidates)


def _noun(key: str) -> str:
    _, service, rest = keys.parse(key)
    return f"{service}/{rest}"


def _describe(files: Sequence[FileFacts]) -> dict[str, Any]:
    own = ("robot", "service", "boot", "package")
    description = {name: value for name, value in files[-1].described.items() if name not in own}
    return description | {"replay": [file.path.name for file in files]}


def _refuse(verb: str) -> Callable[[dict[str, Any]], Any]:
    def refuse(_: dict[str, Any]) -> Any:
        text = f"This is a replay of a recording: it has no motors and cannot '{verb}'."
        if verb in ("stop", "estop", "disable"):
            text += " If a robot moves, another program moves it: cut its power."
        raise CommandRefused(text)

    return refuse


def _ended(name: str) -> Callable[[], Status]:
    return lambda: Status(stamp_ns=time.time_ns(), service=name, state="stopping")
