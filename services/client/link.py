"""Link to one robot: session, readers, publishers, queries, and the errors for messages that do not arrive.

An exchange that the role may not do is refused here at once with an error text; the router refuses it without one.
"""

import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import zenoh

from services.client.live import Presence
from services.command.client_lease import NEEDS_LEASE, ClientLease
from services.errors import NoAnswer, NotAllowed, ServiceError, ServiceUnavailable, TooSlow, WrongVersion
from services.wire import keys, query
from services.wire.caller import Caller, own_name
from services.wire.member import Member, emergency_endpoints, member_in
from services.wire.messages import Message, Sample
from services.wire.query import describe_presence, starter
from services.wire.session import CLIENT, close_session, new_boot, open_with, settings
from services.wire.streams import Publisher, Reader

M = TypeVar("M", bound=Message)

TIMEOUT = 2.0
"""A verb has this deadline [s]."""
SEEN_WITHIN = 0.5
"""A query names a sample of at most this age [s]; the client waits at most this long for the sample."""
LATELY = 2.0
"""A message of another version explains the absence of valid messages for this long [s]."""
ENDS_WITHIN = 1.0
"""The threads of readers have this time [s] to end after the session was closed."""


class Link:
    """Session of a client, with readers and publishers by key.

    Args:
        robot: The robot's name.
        connect: A router's endpoint, or the role file for it, for a robot on another machine.
        name: Name of the client for people; user, host and pid if not given.
    """

    def __init__(self, robot: str, connect: Iterable[str] = (), name: str = "") -> None:
        self.robot = robot
        self.boot = new_boot()
        self.caller = Caller(name or own_name(), self.boot)
        self.member = Member()
        """Role and its robots, from the role file."""
        self.held_lease: ClientLease | None = None
        """Lease of this client until the end of its context, even if the lease was lost."""
        self.changed = threading.Condition()
        """Condition that is notified by every status, and by every service that starts or ends."""
        self._connect = (connect,) if isinstance(connect, str) else tuple(connect)
        self._session: zenoh.Session | None = None
        self._readers: dict[str, Reader[Any]] = {}
        self._publishers: dict[str, Publisher[Any]] = {}
        self._presence: Presence | None = None
        self._make_lock = threading.Lock()

    def open(self, is_emergency: bool = False) -> None:
        """Open the session.

        Args:
            is_emergency: Use the router's port for emergency stops, which accepts nothing else; without such a port in
                the role file use the usual one.

        Raises:
            ServiceError: No session could be opened.
        """
        configuration = settings(self.robot, CLIENT, self._connect)
        if is_emergency and (places := emergency_endpoints(configuration)):
            configuration["connect"]["endpoints"] = places
        self.member = member_in(configuration)
        self._session = open_with(configuration, f"a client of robot '{self.robot}'")

    def close(self) -> None:
        """End the session and its threads; a thread that waits gets an error. Safe to call twice."""
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
        """Open zenoh session.

        Raises:
            ServiceError: The client is not open.
        """
        if self._session is None:
            raise ServiceError(
                f"The client of robot '{self.robot}' is not open: use it in `with Client(...) as robot:`."
            )
        return self._session

    def alive(self) -> set[str]:
        """Return the names of the robot's services that run now, as far as this client is connected."""
        return query.alive(self.session, self.robot)

    def presence(self) -> Presence:
        """Return the set of live services, which is updated from the first call on."""
        with self._make_lock:
            if self._presence is None:
                self._presence = Presence(self.session, self.robot, self.changed)
            return self._presence

    def ask(
        self, service: str, verb: str, arguments: Mapping[str, Any] | None = None, timeout: float = TIMEOUT
    ) -> dict[str, Any]:
        """Query any verb of any service, like `query.ask`.

        Raises:
            NotAllowed: This client's role may not query the verb.
            CommandHeld: Another client commands the robot, and the verb needs the lease.
            LeaseLost: This client's lease was lost, and the verb needs it.
        """
        if not self.member.may_ask(self.robot, service, verb):
            raise NotAllowed(f"The role '{self.member.role}' may not ask the '{service}' service to '{verb}'.")
        key = keys.verb(self.robot, service, verb)
        if verb in NEEDS_LEASE.get(service, ()):
            self.check_lease()
        elif (service, verb) != ("hal", "lease"):
            return query.ask(self.session, key, arguments, timeout, self.caller)
        return query.ask(self.session, key, arguments, timeout, self._dated_caller)

    def check_lease(self) -> None:
        """Raise `LeaseLost` if this client lost its lease."""
        if self.held_lease is not None:
            self.held_lease.check()

    def seen(self, timeout: float = SEEN_WITHIN) -> tuple[int, int]:
        """Return boot and cycle of the HAL's newest sample; zeros if no sample arrives within `timeout` [s].

        A verb that may move the robot carries both numbers, so that a late query is refused.
        """
        reader = self.reader(keys.sample(self.robot), Sample)
        last = reader.last()
        if last is None or time.monotonic() - last.received > SEEN_WITHIN:
            last = reader.newer(last, timeout) or last
        return (0, 0) if last is None else (last.message.boot, last.message.cycle)

    def _dated_caller(self) -> Caller:
        hal_boot, cycle = self.seen()
        return replace(self.caller, hal_boot=hal_boot, cycle=cycle)

    def reader(self, key: str, record: type[M]) -> Reader[M]:
        """Return the reader of a key; the first call makes the reader.

        Raises:
            NotAllowed: This client's role may not read the key.
        """
        with self._make_lock:
            if key not in self._readers:
                _, service, noun = keys.parse(key)
                if not self.member.may_subscribe(self.robot, f"{service}/{noun}"):
                    raise NotAllowed(f"The role '{self.member.role}' may not read {key}.")
                arrived = self.changed if noun == "status" else None
                self._readers[key] = Reader(self.session, key, record, arrived=arrived)
            return self._readers[key]

    def publisher(self, key: str, record: type[M]) -> Publisher[M]:
        """Return the publisher of a key; the first call makes the publisher.

        Raises:
            NotAllowed: This client's role may not publish the key.
        """
        with self._make_lock:
            if key not in self._publishers:
                _, service, noun = keys.parse(key)
                if not self.member.may_publish(self.robot, f"{service}/{noun}"):
                    raise NotAllowed(f"The role '{self.member.role}' may not publish {key}.")
                self._publishers[key] = Publisher(self.session, key, record, self.boot)
            return self._publishers[key]

    def fresh(self, key: str, record: type[M], max_age: float, timeout: float) -> M | None:
        """Return the newest message of a key, not older than `max_age` [s]; None if none arrives within `timeout` [s].

        Raises:
            NotAllowed: This client's role may not read the key.
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
        """Return the error for a key without a message for `waited` [s]."""
        _, service, noun = keys.parse(reader.key)
        if reader.has_ended or self._session is None:
            return ServiceUnavailable(f"The client of robot '{self.robot}' was closed.")
        if text := reader.other_version(waited + LATELY):
            return WrongVersion(f"{text} Update the older of both programs.")
        unread = f" {reader.rejected} messages could not be read: {reader.rejected_text}" if reader.rejected else ""
        if service in self.alive():
            return TooSlow(
                f"The '{service}' service of robot '{self.robot}' is alive, but no '{noun}' came within {waited:.1f} s."
                f" Is the service busy or stopped?{unread}"
            )
        return ServiceUnavailable(
            f"No '{noun}' of the '{service}' service of robot '{self.robot}' came within {waited:.1f} s. "
            f"Is {starter(service)} running?{describe_presence(self.session, self.robot)}{unread}"
        )

    def no_health(self, readers: Iterable[Reader[Any]], waited: float) -> NoAnswer:
        """Return the error for a robot without any message for `waited` [s]."""
        if self._session is None:
            return ServiceUnavailable(f"The client of robot '{self.robot}' was closed.")
        for reader in readers:
            if text := reader.other_version(waited + LATELY):
                return WrongVersion(f"{text} Update the older of both programs.")
        others = describe_presence(self._session, self.robot)
        return ServiceUnavailable(f"No message of robot '{self.robot}' arrived for {waited:.1f} s.{others}")
