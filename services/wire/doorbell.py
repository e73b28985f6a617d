"""Is there somebody behind an endpoint, and does he still read? Ring with nonsense, and see what comes of it."""

import socket
from collections.abc import Sequence

from services.errors import ServiceError

PATIENCE = 2.0
"""How long [s] a router may take to notice."""
SIGN_OF_LIFE = 0.5
"""How long [s] to wait for any."""
_NONSENSE = b"\x01\x00\xff"
"""A message of one byte that is none: zenoh closes the link, TLS sends an alert; either shows that they read."""
_QUIC_UNKNOWN = b"\xc0\x1a\x2a\x3a\x4a\x08gemucoqq\x08gemucoqq".ljust(1200, b"\0")
"""A first packet of a version that does not exist: a QUIC server answers with those it knows (RFC 9000, 6.1)."""
_ANYWHERE = {"0.0.0.0": "127.0.0.1", "[::]": "::1", "": "127.0.0.1"}


def ring(endpoints: Sequence[str]) -> None:
    """Ring at every TCP, TLS and QUIC endpoint in turn; other kinds are passed by.

    Raises:
        ServiceError: Nobody reacts.
    """
    for endpoint in endpoints:
        protocol, _, place = endpoint.partition("/")
        if protocol not in ("tcp", "tls", "quic"):
            continue
        try:
            if protocol == "quic":
                _ring_quic(_where(place), PATIENCE)
            else:
                _ring_tcp(_where(place))
        except OSError as error:
            raise ServiceError(f"Nobody answers at {endpoint}: {error}.") from None


def is_anybody_at(endpoint: str) -> bool:
    """Whether somebody listens at a TCP, TLS, QUIC or websocket endpoint, be he frozen; False for other kinds."""
    protocol, _, place = endpoint.partition("/")
    if protocol not in ("tcp", "tls", "quic", "ws"):
        return False
    try:
        if protocol == "quic":
            _ring_quic(_where(place), SIGN_OF_LIFE)
        else:
            socket.create_connection(_where(place), timeout=SIGN_OF_LIFE).close()
    except OSError:
        return False
    return True


def _where(place: str) -> tuple[str, int]:
    host, _, port = place.partition("?")[0].partition("#")[0].rpartition(":")
    return _ANYWHERE.get(host, host.strip("[]")), int(port)


def _ring_tcp(where: tuple[str, int]) -> None:
    with socket.create_connection(where, timeout=PATIENCE) as link:
        link.settimeout(PATIENCE)
        try:
            link.sendall(_NONSENSE)
            link.recv(64)
        except ConnectionError:
            return  # closed in our face, by somebody who is there


def _ring_quic(where: tuple[str, int], patience: float) -> None:
    family, _, _, _, address = socket.getaddrinfo(*where, type=socket.SOCK_DGRAM)[0]
    with socket.socket(family, socket.SOCK_DGRAM) as link:
        link.settimeout(patience)
        link.connect(address)
        link.send(_QUIC_UNKNOWN)
        link.recv(2048)
