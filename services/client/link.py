"""One robot's link: a session, readers and publishers made when first used, questions, and which error it is.

What a role may not do is refused here, with a sentence and at once; the router refuses it too, and says nothing.
"""

import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import TracebackType
from typing import Any, Self, TypeVar

import zenoh

from services.client.live import Presence
from services.command.client_lease import NEEDS_LEASE, ClientLease
from services.errors import NoAnswer, NotAllowed, ServiceError, ServiceUnavailable, TooSlow, WrongVersion
from services.wire import keys, query
from services.wire.absence import instead, starter
from services.wire.caller import Caller, own_name
from services.wire.member import Member, told_by
from services.wire.messages import Message, Sample
from services.wire.session import CLIENT, close_session, new_boot, opened, settings
from services.wire.streams import Publisher, Reader

M = TypeVar("M", bound=Message)

TIMEOUT = 2.0
"""Deadline [s] of a verb."""
SEEN_WITHIN = 0.5
"""How old [s] the newest sample may be that tells when a question was asked; how long to wait for one."""
LATELY = 2.0
"""For how long [s] a message of another version counts as the reason why there is no other."""
ENDS_WITHIN = 1.0
"""How long [s] to wait for the readers' threads after the session was closed."""


class Link:
    """A client's session, as a context manager; `Client` says what can be done with it.

    Args:
        robot: The robot's name.
        connect: A router's endpoint, or the role file for it, for a robot on another machine.
        name: Who this is, for people; user, host and pid if not given.
    """

    def __init__(self, robot: str, connect: Iterable[str] = (), name: str = "") -> None:
        self.robot = robot
        self.boot = new_boot()
        self.caller = Caller(name or own_name(), self.boot)
        self.member = Member()
        """The role, and the robots that it is for, as the role file says."""
        self.held_lease: ClientLease | None = None
        """The lease, while this client has or had one."""
        self.changed = threading.Condition()
        """Notified of every status, and of every service that comes or goes."""
        self._connect = (connect,) if isinstance(connect, str) else tuple(connect)
        self._session: zenoh.Session | None = None
        self._readers: dict[str, Reader[Any]] = {}
        self._publishers: dict[str, Publisher[Any]] = {}
        self._presence: Presence | None = None
        self._making = threading.Lock()

    def __enter__(self) -> Self:
        configuration = settings(self.robot, CLIENT, self._connect)
        self.member = told_by(configuration)
        self._session = opened(configuration, f"a client of robot '{self.robot}'")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the session and all threads of it; whoever waits on another thread gets an error. Safe to call twice."""
        session, self._session = self._session, None
        if session is None:
            return
        close_session(session)
        deadline = time.monotonic() + ENDS_WITHIN
        for reader in self._readers.values():
            reader.join(max(0.0, deadline - time.monotonic()))
        self._readers.clear()
        self._publishers.clear()
        self._presence = None

    @property
    def session(self) -> zenoh.Session:
        """The open session.

        Raises:
            ServiceError: The client is not open.
        """
        if self._session is None:
            raise ServiceError(
                f"The client of robot '{self.robot}' is not open: use it in `with Client(...) as robot:`."
            )
        return self._session

    def alive(self) -> set[str]:
        """Names of the robot's services that run now, as far as this client is connected."""
        return query.alive(self.session, self.robot)

    def presence(self) -> Presence:
        """Which services are alive, kept up to date from the first use on."""
        with self._making:
            if self._presence is None:
                self._presence = Presence(self.session, self.robot, self.changed)
            return self._presence

    def ask(
        self, service: str, verb: str, arguments: Mapping[str, Any] | None = None, timeout: float = TIMEOUT
    ) -> dict[str, Any]:
        """Ask any verb of any service; see `query.ask`.

        Raises:
            NotAllowed: This client's role may not ask it.
            CommandHeld: Somebody else commands the robot, and the verb is not for everybody.
            LeaseLost: This client's lease was lost, and the verb needs it.
        """
        if not self.member.may_ask(self.robot, service, verb):
            raise NotAllowed(f"The role '{self.member.role}' may not ask the '{service}' service to '{verb}'.")
        key = keys.verb(self.robot, service, verb)
        if verb in NEEDS_LEASE.get(service, ()):
            self.check_lease()
        elif (service, verb) != ("hal", "lease"):
            return query.ask(self.session, key, arguments, timeout, self.caller)
        return query.ask(self.session, key, arguments, timeout, self._who_saw)

    def check_lease(self) -> None:
        """Raise `LeaseLost` if this client had a lease, and lost it."""
        if self.held_lease is not None:
            self.held_lease.check()

    def seen(self, timeout: float = SEEN_WITHIN) -> tuple[int, int]:
        """Run and cycle of the HAL's newest sample here: what may move the robot tells them, so that it is done at once
        or never. Zeros if none arrives in `timeout` [s].
        """
        reader = self.reader(keys.sample(self.robot), Sample)
        last = reader.last()
        if last is None or time.monotonic() - last.received > SEEN_WITHIN:
            last = reader.newer(last, timeout) or last
        return (0, 0) if last is None else (last.message.boot, last.message.cycle)

    def _who_saw(self) -> Caller:
        hal_boot, cycle = self.seen()
        return replace(self.caller, hal_boot=hal_boot, cycle=cycle)

    def reader(self, key: str, record: type[M]) -> Reader[M]:
        """The reader of a key, made when first asked for.

        Raises:
            NotAllowed: This client's role may not read it.
        """
        with self._making:
            if key not in self._readers:
                _, service, noun = keys.parse(key)
                if not self.member.may_hear(self.robot, f"{service}/{noun}"):
                    raise NotAllowed(f"The role '{self.member.role}' may not read {key}.")
                arrived = self.changed if noun == "status" else None
                self._readers[key] = Reader(self.session, key, record, arrived=arrived)
            return self._readers[key]

    def publisher(self, key: str, record: type[M]) -> Publisher[M]:
        """The publisher of a key, made when first asked for.

        Raises:
            NotAllowed: This client's role may not publish it.
        """
        with self._making:
            if key not in self._publishers:
                _, service, noun = keys.parse(key)
                if not self.member.may_say(self.robot, f"{service}/{noun}"):
                    raise NotAllowed(f"The role '{self.member.role}' may not publish {key}.")
                self._publishers[key] = Publisher(self.session, key, record, self.boot)
            return self._publishers[key]

    def fresh(self, key: str, record: type[M], max_age: float, timeout: float) -> M | None:
        """The newest message of a key; None if none arrived in the last `max_age` [s], nor in `timeout` [s] from now.

        Raises:
            NotAllowed: This client's role may not read it.
            WrongVersion: Only messages of another version arrive.
        """
        reader = self.reader(key, record)
        deadline = time.monotonic() + timeout
        while True:
            last, message, left = reader.last(), reader.get(max_age), deadline - time.monotonic()
            if message is not None or left <= 0 or reader.newer(last, left) is None:
                break
        if message is None and (text := reader.other_version(max_age + timeout + LATELY)):
            raise WrongVersion(f"{text} Update the older of both programs.")
        return message

    def silence(self, reader: Reader[Any], waited: float) -> NoAnswer:
        """Why nothing came on a key for so long [s]: the error to raise."""
        _, service, noun = keys.parse(reader.key)
        if reader.has_ended or self._session is None:
            return ServiceUnavailable(f"The client of robot '{self.robot}' was closed.")
        if text := reader.other_version(waited + LATELY):
            return WrongVersion(f"{text} Update the older of both programs.")
        unread = f" {reader.rejected} messages could not be read: {reader.rejected_text}" if reader.rejected else ""
        if service in self.alive():
            return TooSlow(
                f"The '{service}' service of robot '{self.robot}' is there, but no '{noun}' came within {waited:.1f} s."
                f" Is it busy, or stopped?{unread}"
            )
        return ServiceUnavailable(
            f"No '{noun}' of the '{service}' service of robot '{self.robot}' came within {waited:.1f} s. "
            f"Is {starter(service)} running?{instead(self.session, self.robot)}{unread}"
        )

    def no_health(self, readers: Iterable[Reader[Any]], waited: float) -> NoAnswer:
        """Why nothing was heard of any service for so long [s]: the error to raise."""
        if self._session is None:
            return ServiceUnavailable(f"The client of robot '{self.robot}' was closed.")
        for reader in readers:
            if text := reader.other_version(waited + LATELY):
                return WrongVersion(f"{text} Update the older of both programs.")
        found = instead(self._session, self.robot)
        return ServiceUnavailable(f"Nothing was heard of robot '{self.robot}' for {waited:.1f} s.{found}")
