"""Verbs: a query with a msgpack map in, and a msgpack map out that holds the answer or the error.

An exception of the handler travels as its class name and sentence, and comes back as the exception it was.
"""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import msgpack
import numpy as np
import zenoh

from gemuco.errors import SchemaError
from hal.errors import HalError
from services import keys
from services.errors import RemoteError, ServiceError, ServiceUnavailable
from services.messages import MAX_BYTES, MessageError

log = logging.getLogger(__name__)

Handler = Callable[[dict[str, Any]], Any]
RETRY_AFTER = 0.02
"""Pause [s] before asking again when nobody was there: connections are made in the background."""
APPEAR = 2.0
"""How long [s] nobody may be there before the answer is that nobody is; a verb that computes may take longer."""
STARTED_BY = {
    "simulator": "gemuco simulate",
    "hal": "gemuco hal",
    "vision": "gemuco vision",
    "model": "gemuco serve",
    "recorder": "gemuco record",
}


def serve_verb(session: zenoh.Session, key: str, handler: Handler) -> zenoh.Queryable:
    """Answer queries on a key until the session closes.

    Args:
        session: An open session.
        key: From `keys.verb`.
        handler: Takes the arguments, returns what msgpack can carry (arrays become lists); its exceptions become
            replies. Calls come one after another from a thread of zenoh, so long work belongs elsewhere.
    """

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(key, _answer(key, query.payload, handler))

    return session.declare_queryable(key, answer)


def _answer(key: str, payload: zenoh.ZBytes | None, handler: Handler) -> bytes:
    try:
        return _pack({"ok": handler(_arguments(key, payload))})
    except (HalError, SchemaError, ServiceError, ValueError, LookupError) as error:
        return _pack({"error": type(error).__name__, "text": str(error)})
    except Exception as error:
        log.exception("Verb %s failed", key)
        return _pack({"error": type(error).__name__, "text": f"The verb failed: {error}"})


def _arguments(key: str, payload: zenoh.ZBytes | None) -> dict[str, Any]:
    data = payload.to_bytes() if payload is not None else b""
    if not data:
        return {}
    arguments = _unpack(data, f"The arguments of {key}")
    if not all(isinstance(name, str) for name in arguments):
        raise MessageError(f"The arguments of {key} have keys that are not names.")
    return arguments


def ask(
    session: zenoh.Session, key: str, arguments: Mapping[str, Any] | None = None, timeout: float = 2.0
) -> dict[str, Any]:
    """Ask a service to do its verb, and wait for the answer.

    Args:
        session: An open session.
        key: From `keys.verb`.
        arguments: What the verb takes; arrays travel as lists.
        timeout: Deadline [s] for everything, the connection included.

    Returns:
        What the handler returned: a map, or `{"value": ...}` when it returned something else, or `{}`.

    Raises:
        ServiceUnavailable: No answer within the deadline.
        ServiceError, HalError, SchemaError: What the service raised; `RemoteError` when the class is not known here.
    """
    begun = time.monotonic()
    deadline, appear = begun + timeout, begun + min(timeout, APPEAR)
    payload = _pack(dict(arguments or {}))
    late = False
    while (remaining := deadline - time.monotonic()) > 0:
        for reply in session.get(key, payload=payload, timeout=remaining):
            if reply.ok is not None:
                return _result(key, reply.ok.payload.to_bytes())
            late = True
        # Without a queryable, zenoh returns at once: the service is absent, or its connection is being made.
        if not late and time.monotonic() > appear:
            break
        time.sleep(max(0.0, min(RETRY_AFTER, deadline - time.monotonic())))
    raise _unavailable(session, key, timeout if late else min(timeout, APPEAR), late)


def alive(session: zenoh.Session, robot: str, timeout: float = 0.5) -> set[str]:
    """Names of the robot's services that this session can see now."""
    replies = session.liveliness().get(keys.alive(robot, "*"), timeout=timeout)
    return {keys.parse(str(reply.ok.key_expr))[1] for reply in replies if reply.ok is not None}


def _unavailable(session: zenoh.Session, key: str, timeout: float, late: bool) -> ServiceUnavailable:
    robot, service, verb = keys.parse(key)
    verb = verb.removeprefix("do/")
    if late:
        return ServiceUnavailable(
            f"The '{service}' service of robot '{robot}' did not answer '{verb}' within {timeout:g} s. Is it busy?"
        )
    if service in alive(session, robot):
        return ServiceUnavailable(f"The '{service}' service of robot '{robot}' runs, but has no verb '{verb}' (yet).")
    starter = STARTED_BY.get(service, f"the '{service}' service")
    return ServiceUnavailable(
        f"No '{service}' service of robot '{robot}' answered within {timeout:g} s. Is `{starter}` running?"
    )


def _result(key: str, data: bytes) -> dict[str, Any]:
    reply = _unpack(data, f"The answer of {key}")
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
    return msgpack.packb(value, default=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, set | frozenset):
        return sorted(value)
    return str(value)


def _unpack(data: bytes, what: str) -> dict[str, Any]:
    if len(data) > MAX_BYTES:
        raise MessageError(f"{what} of {len(data)} bytes are over the limit of {MAX_BYTES}.")
    try:
        body = msgpack.unpackb(data)
    except (ValueError, msgpack.UnpackException) as error:
        raise MessageError(f"{what} are not msgpack: {error or type(error).__name__}.") from None
    if not isinstance(body, dict):
        raise MessageError(f"{what} are {type(body).__name__}, not a map.")
    return body
