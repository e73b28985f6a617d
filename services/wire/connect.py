"""The items of `connect`: endpoints, and role files, which are zenoh configurations merged into ours."""

import base64
import contextlib
import copy
import json
import logging
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from services.errors import ServiceError

log = logging.getLogger(__name__)

PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream", "vsock", "serial")
"""An endpoint begins with one of these; any other item of `connect` is the path of a role file."""
NETWORKED = ("tcp", "udp", "tls", "quic")
WARN_BEFORE = timedelta(days=30)
"""A certificate that ends within this time causes a warning."""
_CONTAINER_SECRETS = Path("/run/secrets")
"""Only the container sees this folder; most tools make its files readable for every user in it."""


def split_connect(connect: Iterable[str]) -> tuple[list[str], list[str]]:
    """Split the items of `connect` into endpoints and role files.

    Raises:
        ServiceError: An endpoint is malformed.
    """
    items = [connect] if isinstance(connect, str) else list(connect)
    is_endpoint = [item.partition("/")[0] in PROTOCOLS for item in items]
    return (
        [checked_endpoint(item) for item, yes in zip(items, is_endpoint, strict=True) if yes],
        [item for item, yes in zip(items, is_endpoint, strict=True) if not yes],
    )


def checked_endpoint(text: str) -> str:
    """Return an endpoint unchanged if it is well formed; zenoh would not name a bad one, or would retry for ever.

    Raises:
        ServiceError: It is malformed.
    """
    protocol, _, place = text.partition("/")
    example = "An endpoint reads tcp/192.168.0.5:7447 or quic/robot.local:7447"
    if protocol not in PROTOCOLS or not place:
        raise ServiceError(f"'{text}' is not an endpoint. {example}; known protocols: {', '.join(PROTOCOLS)}.")
    host, number = host_and_port(place)
    if protocol in NETWORKED and (not host or not number.isdecimal() or int(number) > 65535):
        raise ServiceError(f"The endpoint '{text}' has no host and port. {example}.")
    return text


def host_and_port(place: str) -> tuple[str, str]:
    """Return host (an IPv6 address in brackets) and port of `HOST:PORT?METADATA#OPTIONS`; empty where missing."""
    host, _, port = re.split(r"[?#]", place)[0].rpartition(":")
    return host, port


def role_file(path: str | Path) -> dict[str, Any]:
    """Read a role file, a zenoh configuration in JSON.

    Raises:
        ServiceError: It cannot be read, or is no JSON map.
    """
    try:
        content = json.loads(Path(path).read_text())
    except OSError as error:
        raise ServiceError(
            f"The role file '{path}' cannot be read: {error.strerror}. An endpoint would begin with "
            f"{', '.join(f'{name}/' for name in PROTOCOLS[:4])}."
        ) from None
    except ValueError as error:
        raise ServiceError(f"The role file '{path}' is not JSON: {error}.") from None
    if not isinstance(content, dict):
        raise ServiceError(f"The role file '{path}' holds {type(content).__name__}, not a map.")
    if "metadata" in content and (warning := exposure_warning(path)):
        log.warning("%s", warning)
    return content


def merge(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of `base` with `changes`: inner maps are merged, other values replaced."""
    merged = dict(base)
    for name, value in changes.items():
        before = merged.get(name)
        merged[name] = merge(before, value) if isinstance(before, dict) and isinstance(value, dict) else value
    return merged


def with_role_files(own: dict[str, Any], files: Iterable[str], endpoints: Iterable[str] = ()) -> dict[str, Any]:
    """Return a configuration with role files merged into it; it also connects to `endpoints`.

    Raises:
        ServiceError: A role file cannot be read.
    """
    configuration = own
    for file in files:
        configuration = merge(configuration, role_file(file))
    places = configuration["connect"]["endpoints"]
    places.extend(endpoint for endpoint in endpoints if endpoint not in places)
    return configuration


@contextlib.contextmanager
def with_password_file(configuration: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the configuration with its passwords in a file, from which zenoh reads them; the file is in memory only."""
    complete = copy.deepcopy(dict(configuration))
    login = ((complete.get("transport") or {}).get("auth") or {}).get("usrpwd") or {}
    dictionary = login.pop("dictionary", None)
    if dictionary is None:
        yield complete
        return
    handle = os.memfd_create("passwords")
    try:
        os.write(handle, "".join(f"{user}:{password}\n" for user, password in dictionary.items()).encode())
        login["dictionary_file"] = f"/proc/self/fd/{handle}"
        yield complete
    finally:
        os.close(handle)


def certificate_end(configuration: Mapping[str, Any]) -> datetime | None:
    """Return the time at which the configuration's certificate ends; None without a certificate.

    Raises:
        ServiceError: It cannot be read.
    """
    tls = ((configuration.get("transport") or {}).get("link") or {}).get("tls") or {}
    text = tls.get("connect_certificate_base64") or tls.get("listen_certificate_base64")
    if not text:
        return None
    from cryptography import x509  # takes long, and most sessions have no certificate

    try:
        return x509.load_pem_x509_certificate(base64.b64decode(text)).not_valid_after_utc
    except ValueError as error:
        raise ServiceError(f"The certificate of the role file cannot be read: {error}.") from None


def authority_certificate(configuration: Mapping[str, Any]) -> bytes:
    """Return the certificate of the authority in a configuration, PEM; empty without one."""
    tls = ((configuration.get("transport") or {}).get("link") or {}).get("tls") or {}
    return base64.b64decode(tls.get("root_ca_certificate_base64") or "")


def expiry_warning(configuration: Mapping[str, Any]) -> str:
    """Return a warning if the certificate has ended or ends within `WARN_BEFORE`, else an empty text."""
    until = certificate_end(configuration)
    if until is None:
        return ""
    left, day = until - datetime.now(UTC), f"{until:%Y-%m-%d %H:%M} UTC"
    hint = "See docs/security.md for how to renew it."
    if left <= timedelta():
        return f"The certificate of the role file ended on {day} and is refused. Is this machine's clock right? {hint}"
    return f"The certificate of the role file ends on {day}, in {left.days} days. {hint}" if left < WARN_BEFORE else ""


def exposure_warning(path: str | Path) -> str:
    """Return a warning if other users may read or write a role file, else an empty text."""
    path = Path(path)
    mode = path.stat().st_mode & 0o077
    if not mode or path.resolve().is_relative_to(_CONTAINER_SECRETS):
        return ""
    return (
        f"*** THE ROLE FILE '{path}' HOLDS A PASSWORD AND A KEY, AND OTHERS MAY {'WRITE' if mode & 0o022 else 'READ'} "
        f"IT: chmod 600 '{path}' ***"
    )
