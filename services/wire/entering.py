"""Going in with a role file: what zenoh does not take as it is, and what is about to fail."""

import base64
import contextlib
import copy
import os
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from services.errors import ServiceError

WARN_BEFORE = timedelta(days=30)
_SECRETS_OF_CONTAINERS = Path("/run/secrets")
"""Only the container sees these, and most tools make them readable to all in it."""


@contextlib.contextmanager
def usable(configuration: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The configuration with its passwords where zenoh reads them: a file, which here exists in memory only."""
    found = copy.deepcopy(dict(configuration))
    login = ((found.get("transport") or {}).get("auth") or {}).get("usrpwd") or {}
    dictionary = login.pop("dictionary", None)
    if dictionary is None:
        yield found
        return
    handle = os.memfd_create("passwords")
    try:
        os.write(handle, "".join(f"{user}:{password}\n" for user, password in dictionary.items()).encode())
        login["dictionary_file"] = f"/proc/self/fd/{handle}"
        yield found
    finally:
        os.close(handle)


def ending(configuration: Mapping[str, Any]) -> datetime | None:
    """When the configuration's certificate ends; None if it holds none.

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


def expiry(configuration: Mapping[str, Any]) -> str:
    """That the certificate has ended, or soon will; empty if it has time left."""
    until = ending(configuration)
    if until is None:
        return ""
    left, day = until - datetime.now(UTC), f"{until:%Y-%m-%d %H:%M} UTC"
    how = "See docs/security.md for how to renew it."
    if left <= timedelta():
        return (
            f"The certificate of the role file ended on {day}: nobody lets it in. Is this machine's clock right? {how}"
        )
    return f"The certificate of the role file ends on {day}, in {left.days} days. {how}" if left < WARN_BEFORE else ""


def exposed(path: str | Path) -> str:
    """That others than its owner may read or write a role file; empty if not."""
    path = Path(path)
    mode = path.stat().st_mode & 0o077
    if not mode or path.resolve().is_relative_to(_SECRETS_OF_CONTAINERS):
        return ""
    return (
        f"*** THE ROLE FILE '{path}' HOLDS A PASSWORD AND A KEY, AND OTHERS MAY {'WRITE' if mode & 0o022 else 'READ'} "
        f"IT: chmod 600 '{path}' ***"
    )
