"""Verbs: a query with a msgpack map in, and a msgpack map out that holds the answer or the error.

An exception of the handler travels as its class name and sentence, and comes back as the exception it was. Both ways
an attachment tells the version of the wire format, and on the way there who asks; one that is missing is no error.
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
from services.wire.absence import instead, starter
from services.wire.caller import ASKING, LONGEST_NAME, UNKNOWN, Caller
from services.wire.messages import MAX_BYTES, UNREADABLE, VERSION, MessageError
from services.wire.plain_text import plain, shown

log = logging.getLogger(__name__)

Handler = Callable[[dict[str, Any]], Any]
Guard = Callable[[Caller], None]
RETRY_AFTER = 0.02
"""Pause [s] before asking again when nobody was there: connections are made in the background."""
APPEAR = 2.0
"""How long [s] nobody may be there before the answer is that nobody is; a verb that computes may take longer."""
LONGEST_ERROR = 1000
ASKERS = 64
"""So many callers' attachments are kept, as they are on the wire and as they were read."""
LONGEST_KEPT = 512
"""Longer attachments [bytes], which no honest caller sends, are read each time."""
UNORDERED = (dict, set, frozenset)
"""What may hold a set, or is one."""
LOG_EVERY = 1.0
"""A verb that keeps failing is logged this often [s]."""


class UnderWay:
    """Counts the questions that are being answered, so that who ends can wait for the last answer to go out."""

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
        """Wait so long [s] at most; whether none is left."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._count, within)


def serve_verb(
    session: zenoh.Session,
    key: str,
    handler: Handler,
    guard: Guard | None = None,
    always: bool = False,
    under_way: UnderWay | None = None,
) -> zenoh.Queryable:
    """Answer queries on a key until the session closes.

    A question to several keys at once (`gemuco/arm/hal/do/*`) is refused: who only looks around must set nothing off.

    Args:
        session: An open session.
        key: From `keys.verb`.
        handler: Takes the arguments, returns what msgpack can carry (arrays become lists); its exceptions become
            replies. Calls come one after another from a thread of zenoh, so long work belongs elsewhere. Who asks is in
            `caller.ASKING` meanwhile.
        guard: Takes the caller before that; what it raises is the answer.
        always: Do it whoever asks however badly, with no arguments if those that came cannot be read; for stopping.
        under_way: Counts the questions until they are answered.
    """
    return session.declare_queryable(key, _Verb(key, handler, guard, always, under_way or UnderWay()).answer)


class _Verb:
    """Answers the questions to one key."""

    def __init__(self, key: str, handler: Handler, guard: Guard | None, always: bool, under_way: UnderWay) -> None:
        self._key, self._handler, self._guard, self._always = key, handler, guard, always
        self._under_way = under_way
        self._told = _pack({"v": VERSION})
        self._logged_at = -math.inf

    def answer(self, query: zenoh.Query) -> None:
        """Answer one question; raises nothing, for there is nobody above."""
        try:
            with self._under_way, query:
                answer = self._done(query) if str(query.key_expr) == self._key else self._refusal_of_many(query)
                query.reply(self._key, answer, attachment=self._told)
        except Exception:  # the session closes
            self._log("A question to %s was not answered", self._key)

    def _done(self, query: zenoh.Query) -> bytes:
        token = None
        try:
            caller, arguments = self._read(query)
            token = ASKING.set(caller)
            if self._guard is not None:
                self._guard(caller)
            return _pack({"ok": self._handler(arguments)})
        except (HalError, SchemaError, ServiceError, ValueError, LookupError) as error:
            return _refused(error, str(error))
        except Exception as error:
            self._log("Verb %s failed", self._key)
            return _refused(error, f"The verb failed: {error}")
        finally:
            if token is not None:
                ASKING.reset(token)

    def _read(self, query: zenoh.Query) -> tuple[Caller, dict[str, Any]]:
        caller, arguments = UNKNOWN, {}
        try:
            caller = _caller(self._key, query.attachment)
            arguments = _arguments(self._key, query.payload)
        except (WrongVersion, MessageError):
            if not self._always:
                raise
        return caller, arguments

    def _refusal_of_many(self, query: zenoh.Query) -> bytes:
        return _refused(
            MessageError(), f"'{plain(str(query.key_expr))}' asks several verbs at once; ask '{self._key}' by its name."
        )

    def _log(self, text: str, *about: object) -> None:
        now = time.monotonic()
        if now - self._logged_at >= LOG_EVERY:
            self._logged_at = now
            log.exception(text, *about)


def _refused(error: Exception, text: str) -> bytes:
    return _pack({"error": type(error).__name__, "text": plain(text.replace("\n", " "), LONGEST_ERROR)})


def _caller(key: str, attachment: zenoh.ZBytes | None) -> Caller:
    """Who asks, as far as it tells.

    Raises:
        WrongVersion: It speaks another version.
        MessageError: The attachment is none.
    """
    if attachment is None:
        return UNKNOWN
    told = attachment.to_bytes()
    return _known_caller(key, told) if len(told) <= LONGEST_KEPT else _read_caller(key, told)


@lru_cache(maxsize=ASKERS)
def _known_caller(key: str, attachment: bytes) -> Caller:
    """See `_caller`; most callers ask the same verb again and again."""
    return _read_caller(key, attachment)


def _read_caller(key: str, attachment: bytes) -> Caller:
    told = _unpack(attachment, f"The attachment of a question to {key}")
    _check_version(told, f"The question to {key}")
    name = told.get("name", "")
    numbers = {number: told.get(number, 0) for number in ("boot", "through", "hal_boot", "cycle")}
    if not isinstance(name, str) or not all(type(value) is int for value in numbers.values()):
        raise MessageError(
            f"The attachment of a question to {key} must hold a text `name`, and whole numbers {', '.join(numbers)}."
        )
    return Caller(plain(name, LONGEST_NAME), **numbers)


def _check_version(told: dict[str, Any], what: str) -> None:
    version = told.get("v", VERSION)
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

    Args:
        session: An open session.
        key: From `keys.verb`.
        arguments: What the verb takes; arrays travel as lists.
        timeout: Deadline [s] for everything, the connection included.
        caller: Who asks, or what tells who does, anew each time that nobody was there.

    Returns:
        What the handler returned: a map, or `{"value": ...}` when it returned something else, or `{}`.

    Raises:
        ServiceUnavailable: Nobody is there.
        TooSlow: No answer within the deadline.
        WrongVersion: One of both speaks another version.
        ServiceError, HalError, SchemaError: What the service raised; `RemoteError` when the class is not known here.
    """
    begun = time.monotonic()
    deadline, appear = begun + timeout, begun + min(timeout, APPEAR)
    payload = _pack(dict(arguments or {}))
    late = False
    while (remaining := deadline - time.monotonic()) > 0:
        told = _told(caller if isinstance(caller, Caller) else caller())
        for reply in session.get(key, payload=payload, attachment=told, timeout=remaining):
            if reply.ok is not None:
                return _result(key, reply.ok)
            late = True
        # Without a queryable, zenoh returns at once: the service is absent, or its connection is being made.
        if not late and time.monotonic() > appear:
            break
        time.sleep(max(0.0, min(RETRY_AFTER, deadline - time.monotonic())))
    raise _unanswered(session, key, timeout if late else min(timeout, APPEAR), late)


@lru_cache(maxsize=ASKERS)
def _told(caller: Caller) -> bytes:
    """What a caller tells beside its question; what it does not know it does not tell."""
    return _pack({"v": VERSION} | {name: value for name, value in asdict(caller).items() if value})


def alive(session: zenoh.Session, robot: str, timeout: float = 0.5) -> set[str]:
    """Names of the robot's services that this session can see now."""
    replies = session.liveliness().get(keys.alive(robot, "*"), timeout=timeout)
    return {keys.parse(str(reply.ok.key_expr))[1] for reply in replies if reply.ok is not None}


def _unanswered(session: zenoh.Session, key: str, timeout: float, late: bool) -> NoAnswer:
    robot, service, verb = keys.parse(key)
    verb = verb.removeprefix("do/")
    if late:
        return TooSlow(
            f"The '{service}' service of robot '{robot}' did not answer '{verb}' within {timeout:.3g} s. Is it busy?"
        )
    if service in alive(session, robot):
        return ServiceUnavailable(
            f"The '{service}' service of robot '{robot}' runs, but has no verb '{verb}' (yet), or the router does not "
            "let this client ask it."
        )
    return ServiceUnavailable(
        f"No '{service}' service of robot '{robot}' answered within {timeout:.3g} s. Is {starter(service)} running?"
        f"{instead(session, robot)}"
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
    """With lists, sorted, in place of sets: msgspec would write them in any order."""
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
