"""Verbs: a query carries a msgpack map of arguments, the reply a msgpack map with the result or the error.

An exception of the handler is sent as its class name and text, and raised as the same class by the client. An
attachment of both holds the version of the wire format, and that of the query also the caller; it may be missing.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
import zenoh

from gemuco.errors import SchemaError
from hal.errors import HalError
from services.errors import NoAnswer, RemoteError, ServiceError, ServiceUnavailable, TooSlow, WrongVersion
from services.wire import keys
from services.wire.caller import CURRENT_CALLER, LONGEST_NAME, UNKNOWN, Caller
from services.wire.messages import MAX_BYTES, UNREADABLE, VERSION, MessageError
from services.wire.plain_text import plain, shown

log = logging.getLogger(__name__)

Handler = Callable[[dict[str, Any]], Any]
Guard = Callable[[Caller], None]
RETRY_AFTER = 0.02
"""A client waits this long [s] before it asks an absent service again: connections are made in the background."""
APPEAR = 2.0
"""A service that is absent for this long [s] is reported; a verb that computes may take longer to answer."""
TAKEN = 0.1
"""A service took a query that ends without an answer after this time [s]; the connection was lost meanwhile."""
LONGEST_ERROR = 1000
CACHED_CALLERS = 64
"""The attachments of this many callers are cached in both directions."""
LONGEST_CACHED = 512
"""Longer attachments [bytes], which no regular client sends, are not cached."""
UNORDERED = (dict, set, frozenset)
"""A value of these types is a set or may hold one."""
LOG_EVERY = 1.0
"""A verb that keeps failing is logged this often [s]."""
LOOK_WITHIN = 0.5
"""A look for running services takes at most this long [s]."""
STARTED_BY = {
    "simulator": "gemuco simulate",
    "hal": "gemuco hal",
    "vision": "gemuco vision",
    "model": "gemuco serve",
    "recorder": "gemuco record",
}


class PendingQueries:
    """A count of the queries that are being answered. A service waits for zero before it closes its session."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._count = 0

    def __enter__(self) -> None:
        with self._changed:
            self._count += 1

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._count -= 1
            self._changed.notify_all()

    def wait(self, within: float) -> bool:
        """Wait at most `within` [s] for the last answer; return whether none is left."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._count, within)


def serve_verb(
    session: zenoh.Session,
    key: str,
    handler: Handler,
    guard: Guard | None = None,
    always: bool = False,
    pending: PendingQueries | None = None,
) -> zenoh.Queryable:
    """Answer queries on a key until the session closes.

    A query to several keys at once (`gemuco/arm/hal/do/*`) is refused: a client that explores must not start anything.

    Args:
        session: An open session.
        key: From `keys.verb`.
        handler: Takes the arguments, returns what msgpack can carry (arrays become lists); its exceptions become
            replies. Calls come one after another from a thread of zenoh, so long work belongs elsewhere. The caller is
            in `CURRENT_CALLER` meanwhile.
        guard: Checks the caller first; its exceptions become replies.
        always: Call the handler even if the query is malformed, then without arguments; for stopping.
        pending: Counts the queries until they are answered.
    """
    return session.declare_queryable(key, _Verb(key, handler, guard, always, pending or PendingQueries()).answer)


class _Verb:
    """The handler of the queries to one key."""

    def __init__(self, key: str, handler: Handler, guard: Guard | None, always: bool, pending: PendingQueries) -> None:
        self._key, self._handler, self._guard, self._always = key, handler, guard, always
        self._pending = pending
        self._attachment = _pack({"v": VERSION})
        self._logged_at = -math.inf

    def answer(self, query: zenoh.Query) -> None:
        """Answer one query; log every exception, because zenoh would ignore it."""
        try:
            with self._pending, query:
                answer = self._call(query) if str(query.key_expr) == self._key else self._refuse_several(query)
                query.reply(self._key, answer, attachment=self._attachment)
        except Exception:  # the session closes
            self._log("A query to %s was not answered", self._key)

    def _call(self, query: zenoh.Query) -> bytes:
        token = None
        try:
            caller, arguments = self._read(query)
            token = CURRENT_CALLER.set(caller)
            if self._guard is not None:
                self._guard(caller)
            return _pack({"ok": self._handler(arguments)})
        except (HalError, SchemaError, ServiceError, ValueError, LookupError) as error:
            return _refusal(error, str(error))
        except Exception as error:
            self._log("Verb %s failed", self._key)
            return _refusal(error, f"The verb failed: {error}")
        finally:
            if token is not None:
                CURRENT_CALLER.reset(token)

    def _read(self, query: zenoh.Query) -> tuple[Caller, dict[str, Any]]:
        caller, arguments = UNKNOWN, {}
        try:
            caller = _caller(self._key, query.attachment)
            arguments = _arguments(self._key, query.payload)
        except (WrongVersion, MessageError):
            if not self._always:
                raise
        return caller, arguments

    def _refuse_several(self, query: zenoh.Query) -> bytes:
        return _refusal(
            MessageError(), f"'{plain(str(query.key_expr))}' asks several verbs at once; ask '{self._key}' by its name."
        )

    def _log(self, text: str, *arguments: object) -> None:
        now = time.monotonic()
        if now - self._logged_at >= LOG_EVERY:
            self._logged_at = now
            log.exception(text, *arguments)


def _refusal(error: Exception, text: str) -> bytes:
    return _pack({"error": type(error).__name__, "text": plain(text.replace("\n", " "), LONGEST_ERROR)})


def _caller(key: str, attachment: zenoh.ZBytes | None) -> Caller:
    """Read the caller of a query; `UNKNOWN` without an attachment.

    Raises:
        WrongVersion: It uses another version of the wire format.
        MessageError: The attachment is malformed.
    """
    if attachment is None:
        return UNKNOWN
    data = attachment.to_bytes()
    return _cached_caller(key, data) if len(data) <= LONGEST_CACHED else _read_caller(key, data)


def _read_caller(key: str, attachment: bytes) -> Caller:
    entries = _unpack(attachment, f"The attachment of a query to {key}")
    _check_version(entries, f"The query to {key}")
    name = entries.get("name", "")
    numbers = {number: entries.get(number, 0) for number in ("boot", "through", "hal_boot", "cycle")}
    if not isinstance(name, str) or not all(type(value) is int for value in numbers.values()):
        raise MessageError(
            f"The attachment of a query to {key} must hold a text `name`, and whole numbers {', '.join(numbers)}."
        )
    return Caller(plain(name, LONGEST_NAME), **numbers)


_cached_caller = lru_cache(maxsize=CACHED_CALLERS)(_read_caller)
"""Most callers ask the same verb again and again, so their attachments are read once."""


def _check_version(entries: dict[str, Any], what: str) -> None:
    version = entries.get("v", VERSION)
    if type(version) is not int or version != VERSION:
        raise WrongVersion(
            f"{what} has version {shown(version)} of the wire format; this program speaks {VERSION}. Update the older."
        )


def _arguments(key: str, payload: zenoh.ZBytes | None) -> dict[str, Any]:
    data = payload.to_bytes() if payload is not None else b""
    if not data:
        return {}
    arguments = _unpack(data, f"The arguments of {key}")
    if not all(isinstance(name, str) for name in arguments):
        raise MessageError(f"The arguments of {key} have keys that are not names.")
    return arguments


def ask(
    session: zenoh.Session,
    key: str,
    arguments: Mapping[str, Any] | None = None,
    timeout: float = 2.0,
    caller: Caller | Callable[[], Caller] = UNKNOWN,
) -> dict[str, Any]:
    """Ask a service to do its verb, and wait for the answer.

    A query without an answer is asked again until the deadline, so a service may get it twice.

    Args:
        session: An open session.
        key: From `keys.verb`.
        arguments: What the verb takes; arrays travel as lists.
        timeout: Deadline [s] for everything, the connection included.
        caller: The caller, or a function that returns it, called anew for each attempt.

    Returns:
        What the handler returned: a map, or `{"value": ...}` when it returned something else, or `{}`.

    Raises:
        ServiceUnavailable: The service is absent.
        TooSlow: No answer within the deadline.
        WrongVersion: One side uses another version of the wire format.
        ServiceError, HalError, SchemaError: The service raised it; `RemoteError` if the class is not known here.
    """
    start = time.monotonic()
    deadline, appear = start + timeout, start + min(timeout, APPEAR)
    payload = _pack(dict(arguments or {}))
    late, waited = False, timeout
    while (remaining := deadline - time.monotonic()) > 0:
        attachment, asked = _attachment(caller if isinstance(caller, Caller) else caller()), time.monotonic()
        for reply in session.get(key, payload=payload, attachment=attachment, timeout=remaining):
            if reply.ok is not None:
                return _result(key, reply.ok)
            late = True
        # Without a queryable, zenoh returns at once: the service is absent, or its connection is being made.
        if (ended := time.monotonic()) - asked > TAKEN:
            appear = ended + APPEAR
        if not late and ended > appear:
            waited = min(timeout, APPEAR)
            break
        time.sleep(max(0.0, min(RETRY_AFTER, deadline - time.monotonic())))
    raise _no_answer(session, key, waited, late)


@lru_cache(maxsize=CACHED_CALLERS)
def _attachment(caller: Caller) -> bytes:
    """Encode the version and the fields of the caller that are known."""
    return _pack({"v": VERSION} | {name: value for name, value in asdict(caller).items() if value})


def alive(session: zenoh.Session, robot: str, timeout: float = LOOK_WITHIN) -> set[str]:
    """Return the names of the robot's services that this session can see now."""
    return _running(session, robot, timeout).get(robot, set())


def _running(session: zenoh.Session, robot: str = "*", timeout: float = LOOK_WITHIN) -> dict[str, set[str]]:
    """Return robot -> names of its services that this session can see now."""
    services: dict[str, set[str]] = {}
    for reply in session.liveliness().get(keys.alive(robot, "*"), timeout=timeout):
        if reply.ok is not None:
            name, service, _ = keys.parse(str(reply.ok.key_expr))
            services.setdefault(name, set()).add(service)
    return services


def starter(service: str) -> str:
    """Return the command that starts a service, for a sentence."""
    return f"`{STARTED_BY[service]}`" if service in STARTED_BY else f"the '{service}' service"


def describe_presence(session: zenoh.Session, robot: str) -> str:
    """Describe the services that are visible although the queried one is not: a sentence that begins with a space."""
    if not session.info.transports():
        return f" At the moment this program has no connection: no router, and no service of the robot.{_here(robot)}"
    if services := alive(session, robot):  # first alone: a role may not see other robots
        return f" Running services of this robot: {', '.join(sorted(services))}."
    if others := sorted(_running(session)):
        return f" There is no robot '{robot}'. Visible robots: {', '.join(others)}."
    return " The router runs, but no robot is visible."


def _here(robot: str) -> str:
    """Return the other robots of this machine, whose name may have been meant: a sentence, or empty."""
    from services.runtime import services_here  # a client loads nothing of the HAL before it needs this

    try:
        others = sorted({name for name, _ in services_here() if name != robot})
    except ServiceError:  # no folder of locks, which a client does not need
        return ""
    return f" Robots on this machine: {', '.join(others)}." if others else ""


def _no_answer(session: zenoh.Session, key: str, timeout: float, late: bool) -> NoAnswer:
    robot, service, verb = keys.parse(key)
    verb = verb.removeprefix("do/")
    services = alive(session, robot)
    if late and service in services:  # while other programs come and go, zenoh waits for one that is not there too
        return TooSlow(
            f"The '{service}' service of robot '{robot}' did not answer '{verb}' within {timeout:.3g} s. Is it busy?"
        )
    if service in services:
        return ServiceUnavailable(
            f"The '{service}' service of robot '{robot}' runs, but has no verb '{verb}' (yet), or the router does not "
            "let this client ask it."
        )
    return ServiceUnavailable(
        f"No '{service}' service of robot '{robot}' answered within {timeout:.3g} s. Is {starter(service)} running?"
        f"{describe_presence(session, robot)}"
    )


def _result(key: str, answer: zenoh.Sample) -> dict[str, Any]:
    if answer.attachment is not None:
        _check_version(
            _unpack(answer.attachment.to_bytes(), f"The attachment of the answer of {key}"), f"The answer of {key}"
        )
    reply = _unpack(answer.payload.to_bytes(), f"The answer of {key}")
    if "error" in reply:
        name, text = str(reply["error"]), str(reply.get("text", ""))
        known = {kind.__name__: kind for base in (HalError, SchemaError, ServiceError) for kind in _family(base)}
        raise known[name](text) if name in known else RemoteError(f"{text} ({name} of {keys.parse(key)[1]})")
    value = reply.get("ok")
    if isinstance(value, dict):
        return value
    return {} if value is None else {"value": value}


def _family(base: type[Exception]) -> Iterator[type[Exception]]:
    yield base
    for child in base.__subclasses__():
        yield from _family(child)


def _pack(value: Any) -> bytes:
    return _encoder.encode(_ordered(value))


def _ordered(value: Any) -> Any:
    """Replace sets by sorted lists: msgspec would write sets in any order."""
    if isinstance(value, dict):
        return {key: _ordered(item) if isinstance(item, UNORDERED) else item for key, item in value.items()}
    return sorted(value) if isinstance(value, set | frozenset) else value


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return str(value)


_encoder = msgspec.msgpack.Encoder(enc_hook=_plain)


def _unpack(data: bytes, what: str) -> dict[str, Any]:
    if len(data) > MAX_BYTES:
        raise MessageError(f"{what} of {len(data)} bytes are over the limit of {MAX_BYTES}.")
    try:
        body = msgspec.msgpack.decode(data)
    except UNREADABLE as error:
        raise MessageError(f"{what} are not msgpack: {plain(str(error))}.") from None
    if not isinstance(body, dict):
        raise MessageError(f"{what} are {type(body).__name__}, not a map.")
    return body
