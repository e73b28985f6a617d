"""What all robots of a network tell of themselves once a second, and which of them are in trouble.

Only tokens, statuses and holders are heard: a few kilobytes per robot and second, however fast its loops turn.
"""

import re
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, TypeVar

import zenoh

from hal.clock import Clock, SystemClock
from services.runtime import services_here
from services.wire import keys
from services.wire.member import member_of
from services.wire.messages import Holder, Message, MessageError, Status
from services.wire.session import CLIENT, close_session, endpoint, open_with, settings
from services.wire.streams import received_message

M = TypeVar("M", bound=Message)

SILENT_AFTER = 2.5
"""A service that says nothing for so long [s], its status being due every second, is silent."""
TWIN_FOR = 5.0
"""How long [s] two senders of one status count as two after they were last heard in turns."""
FORGET_AFTER = 600.0
"""How long [s] a robot that has gone stays in sight."""
MOST = 5000
"""Robots that are kept; more names than that are not robots, but somebody who makes them up."""
ROBOT = re.compile(r"[a-z][a-z0-9_]{0,99}$")
"""What robot files may call a robot."""
WHO = "gemuco top"


class Level(IntEnum):
    """How much a robot needs somebody to look at it."""

    GOOD = 0
    DEGRADED = 1
    ANOMALY = 2
    TROUBLE = 3
    GONE = 4


@dataclass(slots=True)
class Voice:
    """One service of a robot, as far as it is heard.

    Attributes:
        status: Its newest status; None before the first.
        heard: When that arrived [monotonic s].
        is_alive: Whether its liveliness token is there.
        boots: When each of its processes was last heard [monotonic s], by boot.
        twin_until: Until when two processes count as speaking under this one name [monotonic s].
    """

    status: Status | None = None
    heard: float = -1e9
    is_alive: bool = False
    boots: dict[int, float] = field(default_factory=dict)
    twin_until: float = -1e9

    def hear(self, status: Status, now: float) -> None:
        """Take a status; one process after the other is a restart, in turns they are two."""
        last = self.status.boot if self.status is not None else status.boot
        if status.boot != last and now - self.boots.get(status.boot, -1e9) < TWIN_FOR:
            self.twin_until = now + TWIN_FOR
        self.boots = {boot: at for boot, at in self.boots.items() if now - at < TWIN_FOR} | {status.boot: now}
        self.status, self.heard = status, now


@dataclass(frozen=True, slots=True)
class Glance:
    """A robot at a glance.

    Attributes:
        robot: Its name.
        level: How bad it is.
        text: What is wrong, in a sentence; empty if nothing is.
        services: Those that are alive, in the order of `keys.SERVICES`.
        motors: Mode of the drives; empty if no HAL tells.
        holder: Who commands; empty if nobody does.
        measured: How many signals are measured, estimated and neither; None if no model tells.
        anomaly: Verdict, and who is blamed; empty if nothing is judged.
        late: Worst lateness of a loop in the last second [s], and which; None if no loop tells.
        age: How long ago [s] anything was heard.
    """

    robot: str
    level: Level
    text: str
    services: tuple[str, ...]
    motors: str
    holder: str
    measured: tuple[int, int, int] | None
    anomaly: str
    late: tuple[float, str] | None
    age: float


class RobotNews:
    """All that was heard of one robot."""

    def __init__(self, robot: str, now: float) -> None:
        self.robot = robot
        self.voices: dict[str, Voice] = {}
        self.holder: tuple[float, Holder] | None = None
        self.heard = now
        """When it was last heard or seen to be alive [monotonic s]."""

    def voice(self, service: str) -> Voice:
        """That of a service, made when first heard."""
        return self.voices.setdefault(service, Voice())

    @property
    def is_told(self) -> bool:
        """Whether every service that is alive has told its status."""
        alive = [voice for voice in self.voices.values() if voice.is_alive]
        return bool(alive) and all(voice.status is not None for voice in alive)

    def glance(self, now: float) -> Glance:
        """How it is now [monotonic s]."""
        alive = tuple(name for name in keys.SERVICES if name in self.voices and self.voices[name].is_alive)
        hal, model = self._fresh("hal", now), self._fresh("model", now)
        facts = model.facts if model is not None else {}
        level, text = self._judge(alive, facts, now)
        holder = self.holder[1].name if self.holder is not None and now - self.holder[0] < SILENT_AFTER else ""
        return Glance(
            robot=self.robot,
            level=level,
            text=text,
            services=alive,
            motors=_word(hal.facts.get("mode")) if hal is not None else "",
            holder=holder,
            measured=_counts(facts.get("signals")),
            anomaly=_anomaly(facts),
            late=self._late(now),
            age=now - self.heard,
        )

    def _fresh(self, service: str, now: float) -> Status | None:
        voice = self.voices.get(service)
        return voice.status if voice is not None and now - voice.heard < SILENT_AFTER else None

    def _judge(self, alive: tuple[str, ...], facts: Mapping[str, Any], now: float) -> tuple[Level, str]:
        """What is worst."""
        if not alive and now - self.heard >= SILENT_AFTER:
            ended = any(voice.status and voice.status.state == "stopping" for voice in self.voices.values())
            return Level.GONE, "It was told to end." if ended else "Nothing is heard of it any more."
        if twins := [name for name, voice in self.voices.items() if now < voice.twin_until]:
            return Level.TROUBLE, f"Two '{twins[0]}' services speak under this name: give one robot another name."
        for name in alive:
            voice, known = self.voices[name], self._fresh(name, now)
            if known is None and voice.status is not None:
                return Level.TROUBLE, f"'{name}' is alive and says nothing: is it frozen?"
            if known is not None and known.state == "fault":
                return Level.TROUBLE, f"{name}: {known.text or 'fault'}"
        if missing := [name for name in ("hal", "model") if name in self.voices and name not in alive]:
            return Level.TROUBLE, f"'{missing[0]}' is gone."
        if _is_anomaly(facts):
            return Level.ANOMALY, f"model: {_anomaly(facts)}"
        for name in alive:
            known = self._fresh(name, now)
            if known is not None and known.state not in ("running", "ready"):
                return Level.DEGRADED, f"{name}: {known.text or known.state}"
        return Level.GOOD, ""

    def _late(self, now: float) -> tuple[float, str] | None:
        loops = [
            (loop.get("late_max", 0.0), name)
            for service in self.voices
            if (status := self._fresh(service, now)) is not None
            for name, loop in status.loops.items()
        ]
        return max(loops, default=None)


class FleetWatch:
    """Hears all robots: through the router or role file that `connect` names, else those that run on this machine.

    A context manager. On this machine there is no discovery: robots are found by their locks, so call `look` now and
    then.

    Args:
        connect: Endpoints, such as a router's, and role files.
        clock: What time it is.
    """

    def __init__(self, connect: Iterable[str] = (), clock: Clock | None = None) -> None:
        self.rejected = 0
        """Messages that could not be read."""
        self.strange = 0
        """Messages of services that are none, or of more robots than are kept."""
        self._connect = tuple(connect)
        self._clock = clock or SystemClock()
        self._lock = threading.Lock()
        self._news: dict[str, RobotNews] = {}
        self._here: list[tuple[str, str]] = []
        self._session: zenoh.Session | None = None
        self._held: list[Any] = []

    def __enter__(self) -> "FleetWatch":
        self._open()
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    @property
    def has_router(self) -> bool:
        """Whether the place that `connect` names is linked; true where none is named."""
        return not self._connect or (self._session is not None and bool(list(self._session.info.routers_zid())))

    def look(self) -> None:
        """Look for services that were started on this machine meanwhile."""
        if not self._connect and set(services_here()) - set(self._here):
            self._close()
            self._open()

    def glances(self) -> list[Glance]:
        """All robots, trouble first, then by name."""
        now = self._clock.monotonic()
        with self._lock:
            for robot in [name for name, news in self._news.items() if now - news.heard > FORGET_AFTER]:
                if not any(voice.is_alive for voice in self._news[robot].voices.values()):
                    del self._news[robot]
            found = [news.glance(now) for news in self._news.values()]
        return sorted(found, key=lambda one: (-one.level, one.robot))

    def is_told(self) -> bool:
        """Whether somebody is there, and every service that is alive has told its status."""
        with self._lock:
            return bool(self._news) and all(news.is_told for news in self._news.values())

    def _open(self) -> None:
        self._here = [] if self._connect else services_here()
        found = settings("", CLIENT, self._connect)
        if not self._connect:
            found["connect"]["endpoints"] = [endpoint(robot, service) for robot, service in self._here]
        self._session = session = open_with(found, WHO)
        for robot in _robots(self._connect):
            self._held += [
                session.liveliness().declare_subscriber(keys.alive(robot, "*"), self._see, history=True),
                session.declare_subscriber(keys.status(robot, "*"), self._hear),
                session.declare_subscriber(keys.holder(robot), self._hear_holder),
            ]

    def _close(self) -> None:
        self._held.clear()
        if self._session is not None:
            close_session(self._session)
        with self._lock:
            for news in self._news.values():
                for voice in news.voices.values():
                    voice.is_alive = False  # the next session tells anew

    def _voice(self, key: str) -> tuple[RobotNews, Voice, float] | None:
        """Who speaks, and the time; None if that is nobody. Call with the lock held."""
        _, robot, service, *_ = key.split("/")  # `gemuco/<robot>/<service>/...`, or it would not have been delivered
        now = self._clock.monotonic()
        is_odd = service not in keys.SERVICES or not ROBOT.match(robot)
        if is_odd or (robot not in self._news and len(self._news) >= MOST):
            self.strange += 1
            return None
        news = self._news.setdefault(robot, RobotNews(robot, now))
        news.heard = now
        return news, news.voice(service), now

    def _see(self, sample: zenoh.Sample) -> None:
        with self._lock:
            if found := self._voice(str(sample.key_expr)):
                found[1].is_alive = sample.kind == zenoh.SampleKind.PUT

    def _hear(self, sample: zenoh.Sample) -> None:
        if (status := self._decoded(sample, Status)) is None:
            return
        with self._lock:
            if found := self._voice(str(sample.key_expr)):
                found[1].hear(status, found[2])

    def _hear_holder(self, sample: zenoh.Sample) -> None:
        if (holder := self._decoded(sample, Holder)) is None:
            return
        with self._lock:
            if found := self._voice(str(sample.key_expr)):
                found[0].holder = (found[2], holder)

    def _decoded(self, sample: zenoh.Sample, record: type[M]) -> M | None:
        try:
            return received_message(sample, record)
        except MessageError:
            self.rejected += 1
            return None


def _robots(connect: tuple[str, ...]) -> list[str]:
    """The robots that a role file is for, since a wider subscription than is allowed is none; else all."""
    return list(member_of(connect).robots) or ["*"]


def _counts(told: Any) -> tuple[int, int, int] | None:
    if not isinstance(told, dict):
        return None
    found = [told.get(name) for name in ("measured", "estimated", "none")]
    return (found[0], found[1], found[2]) if all(isinstance(one, int) for one in found) else None  # type: ignore[return-value]


def _word(told: Any) -> str:
    """A word out of the free part of a status, which may hold anything."""
    return told if isinstance(told, str) else ""


def _is_anomaly(facts: Mapping[str, Any]) -> bool:
    told = facts.get("anomaly")
    return isinstance(told, dict) and told.get("is_anomaly") is True


def _anomaly(facts: Mapping[str, Any]) -> str:
    told = facts.get("anomaly")
    if not isinstance(told, dict):
        return ""
    verdict, blamed = _word(told.get("verdict")), _word(told.get("blamed"))
    return f"anomaly in {blamed}" if _is_anomaly(facts) and blamed else verdict
