"""What `connect` holds: endpoints, and role files, which are zenoh configurations that are laid over ours."""

import json
import logging
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from services.errors import ServiceError
from services.wire.entering import exposed

log = logging.getLogger(__name__)

PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream", "vsock", "serial")
"""What an endpoint begins with; anything else in `connect` is the path of a role file."""
NETWORKED = ("tcp", "udp", "tls", "quic")


def role_file(path: str | Path) -> dict[str, Any]:
    """A zenoh configuration in JSON.

    Raises:
        ServiceError: It cannot be read, or is no JSON map.
    """
    try:
        found = json.loads(Path(path).read_text())
    except OSError as error:
        raise ServiceError(
            f"The role file '{path}' cannot be read: {error.strerror}. An endpoint would begin with "
            f"{', '.join(f'{name}/' for name in PROTOCOLS[:4])}."
        ) from None
    except ValueError as error:
        raise ServiceError(f"The role file '{path}' is not JSON: {error}.") from None
    if not isinstance(found, dict):
        raise ServiceError(f"The role file '{path}' holds {type(found).__name__}, not a map.")
    if "metadata" in found and (said := exposed(path)):
        log.warning("%s", said)
    return found


def merged(under: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """A map with another laid over it: inner maps are merged, everything else is replaced."""
    found = dict(under)
    for name, value in over.items():
        before = found.get(name)
        found[name] = merged(before, value) if isinstance(before, dict) and isinstance(value, dict) else value
    return found


def sorted_out(connect: Iterable[str]) -> tuple[list[str], list[str]]:
    """Endpoints and role files, of which `connect` is a mixture.

    Raises:
        ServiceError: An endpoint is malformed.
    """
    items = [connect] if isinstance(connect, str) else list(connect)
    is_endpoint = [item.partition("/")[0] in PROTOCOLS for item in items]
    return (
        [checked_endpoint(item) for item, found in zip(items, is_endpoint, strict=True) if found],
        [item for item, found in zip(items, is_endpoint, strict=True) if not found],
    )


def checked_endpoint(text: str) -> str:
    """The same endpoint; zenoh tells what is wrong with one without naming it, or tries for ever.

    Raises:
        ServiceError: It is malformed.
    """
    protocol, _, place = text.partition("/")
    example = "An endpoint reads tcp/192.168.0.5:7447 or quic/robot.local:7447"
    if protocol not in PROTOCOLS or not place:
        raise ServiceError(f"'{text}' is not an endpoint. {example}; known protocols: {', '.join(PROTOCOLS)}.")
    host, _, number = re.split(r"[?#]", place)[0].rpartition(":")
    if protocol in NETWORKED and (not host or not number.isdecimal() or int(number) > 65535):
        raise ServiceError(f"The endpoint '{text}' has no host and port. {example}.")
    return text


def laid_over(own: dict[str, Any], files: Iterable[str], endpoints: Iterable[str] = ()) -> dict[str, Any]:
    """A configuration with role files laid over it; endpoints that were asked for beside them stay.

    Raises:
        ServiceError: A role file cannot be read.
    """
    found = own
    for file in files:
        found = merged(found, role_file(file))
    kept = found["connect"]["endpoints"]
    kept.extend(one for one in endpoints if one not in kept)
    return found
