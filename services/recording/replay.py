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
from typing import Any

from msgspec.structs import replace

from hal.errors import CommandRefused
from services.errors import BadArguments, RecordingError
from services.process.service import Service, until_stopped
from services.recording.reading import FileFacts, Paths, Recorded, facts_of, one_robot, read
from services.recording.schedule import LATE, ReplayCounts, Schedule
from services.recording.writer import CARRIED
from services.wire import keys
from services.wire.records import Applied, Message, Sample, Status
from services.wire.session import new_boot
from services.wire.streams import Publisher

log = logging.getLogger(__name__)

SOURCE = "replay"
MEASURED = ("hal/sample", "hal/applied", "vision/sample")
INFERRED = ("model/estimate", "model/anomaly", "model/update")
MOST_STEPS = 100_000
MOVES = ("enable", "disable", "home", "tare", "reset", "stop", "estop", "lease", "release")
"""A replay refuses these verbs of a HAL."""


class Replay:
    """Replay of recordings on the sessions of the replaced services.

    Args:
        services: Services by name; `hal` is among them.
        files: Facts of the played files.
        messages: Returns the messages of the files in order, from an arrival on [ns].
        speed: Multiple of the recorded speed; 0 begins with a pause.
        stop: Event that ends the replay; the replay sets it after the last message.
    """

    def __init__(
        self,
        services: dict[str, Service],
        files: Sequence[FileFacts],
        messages: Callable[[int], Iterator[Recorded]],
        speed: float,
        stop: threading.Event,
    ) -> None:
        self.counts = ReplayCounts()
        self._services, self._files, self._messages, self._speed, self._stop = services, files, messages, speed, stop
        self._begin_ns = min(file.begin_ns for file in files)
        self._schedule = Schedule(speed, self._begin_ns, stop, self.counts)
        self._publishers: dict[tuple[str, int], Publisher[Any]] = {}
        self._boots: dict[int, int] = {}
        self._mode = ""
        self._failure = ""
        hal = services["hal"]
        for verb in MOVES:
            hal.verb(verb, _refuse(verb), always=True)
        hal.verb("step", self._step)
        hal.verb("seek", self._seek)
        hal.verb("pause", lambda arguments: self._act("pause", arguments, self._schedule.pause))
        hal.verb("play", lambda arguments: self._act("play", arguments, self._schedule.play))

    @property
    def length(self) -> float:
        """Time that the files cover, with the pauses between them [s]."""
        return (max(file.end_ns for file in self._files) - self._begin_ns) * 1e-9

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
        since_ns: int | None = 0
        try:
            while since_ns is not None:
                for recorded in self._messages(since_ns):
                    if not self._schedule.wait(recorded.received_ns):
                        break
                    self._publish(recorded, self._schedule.stamp_ns(recorded.message.stamp_ns, recorded.received_ns))
                since_ns = self._schedule.taken()
        except RecordingError as error:
            self._failure = str(error)
        finally:
            self._stop.set()
            self._schedule.end()

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
        count = arguments.get("count", 1)
        is_number = isinstance(count, int) and not isinstance(count, bool)
        if set(arguments) - {"count"} or not is_number or not 1 <= count <= MOST_STEPS:
            raise BadArguments(f"step takes {{count: 1 to {MOST_STEPS}}}, the number of samples to play.")
        return self._act("step", {}, lambda: self._schedule.allow(count, within=1.0))

    def _seek(self, arguments: dict[str, Any]) -> dict[str, Any]:
        to = arguments.get("to")
        is_number = isinstance(to, int | float) and not isinstance(to, bool) and 0.0 <= to <= self.length
        if set(arguments) - {"to"} or not is_number or to is None:
            raise BadArguments(f"seek takes {{to: 0 to {self.length:.1f}}}, the time since the beginning [s].")
        return self._act("seek", {}, lambda: self._schedule.seek(self._begin_ns + round(1e9 * to), within=1.0))

    def _act(self, verb: str, arguments: dict[str, Any], act: Callable[[], None]) -> dict[str, Any]:
        """Change the schedule, publish the new state at once, and return it."""
        if arguments:
            raise BadArguments(f"{verb} takes no arguments.")
        act()
        if not self._stop.is_set():
            self._services["hal"].publish_status(lambda: self._status("hal"))
        counts = self.counts
        return {
            "samples": counts.samples,
            "reached": counts.reached,
            "position": counts.position,
            "paused": self._schedule.is_paused,
            "ended": self._stop.is_set(),
        }

    def _statuses(self) -> Status:
        for name, service in self._services.items():
            if name != "hal":
                service.publish_status(lambda name=name: self._status(name))  # type: ignore[misc]
        return self._status("hal")

    def _status(self, name: str) -> Status:
        counts = self.counts
        is_paused = self._schedule.is_paused
        speed = "that is paused" if is_paused else f"at {self._speed or 1.0:g} x"
        text = f"A replay {speed}, not a robot: {counts.position:.1f} of {self.length:.1f} s."
        facts: dict[str, Any] = {
            "replay": {
                "files": [file.path.name for file in self._files],
                "speed": self._speed,
                "length": self.length,
                "paused": is_paused,
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
        speed: Multiple of the recorded speed; 0 begins with a pause, for `hal/do/step` and `hal/do/play`.
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
        played = [file.path for file in files]
        replay = Replay(services, files, lambda since_ns: read(played, playable, since_ns), speed, stopped)
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
