"""Check whether a process listens at an endpoint: send it an invalid message and wait for any reaction."""

import socket
from collections.abc import Sequence

from services.errors import ServiceError
from services.wire.connect import host_and_port

PATIENCE = 2.0
"""A router has to react within this time [s]."""
LISTEN_WITHIN = 0.5
"""A listener has to accept within this time [s]."""
_INVALID = b"\x01\x00\xff"
"""A message of one invalid byte: zenoh closes the link and TLS sends an alert, so both show that they read it."""
_QUIC_UNKNOWN = b"\xc0\x1a\x2a\x3a\x4a\x08gemucoqq\x08gemucoqq".ljust(1200, b"\0")
"""A first packet of an unknown version: a QUIC server answers with the versions it supports (RFC 9000, 6.1)."""
_ANY_HOST = {"0.0.0.0": "127.0.0.1", "[::]": "::1", "": "127.0.0.1"}


def check_answers(endpoints: Sequence[str]) -> None:
    """Check that every TCP, TLS and QUIC endpoint reacts; skip other kinds.

    Raises:
        ServiceError: An endpoint does not react.
    """
    for endpoint in endpoints:
        protocol, _, place = endpoint.partition("/")
        if protocol not in ("tcp", "tls", "quic"):
            continue
        try:
            if protocol == "quic":
                _probe_quic(_address(place), PATIENCE)
            else:
                _probe_tcp(_address(place))
        except OSError as error:
            raise ServiceError(f"No answer at {endpoint}: {error}.") from None


def is_listening(endpoint: str) -> bool:
    """Whether a process, even a frozen one, listens at a TCP, TLS, QUIC or ws endpoint; False for others."""
    protocol, _, place = endpoint.partition("/")
    if protocol not in ("tcp", "tls", "quic", "ws"):
        return False
    try:
        if protocol == "quic":
            _probe_quic(_address(place), LISTEN_WITHIN)
        else:
            socket.create_connection(_address(place), timeout=LISTEN_WITHIN).close()
    except OSError:
        return False
    return True


def _address(place: str) -> tuple[str, int]:
    host, port = host_and_port(place)
    return _ANY_HOST.get(host, host.strip("[]")), int(port)


def _probe_tcp(address: tuple[str, int]) -> None:
    with socket.create_connection(address, timeout=PATIENCE) as link:
        link.settimeout(PATIENCE)
        try:
            link.sendall(_INVALID)
            link.recv(64)
        except ConnectionError:
            return  # the other side closed the link, so it reads


def _probe_quic(address: tuple[str, int], patience: float) -> None:
    family, _, _, _, resolved = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM)[0]
    with socket.socket(family, socket.SOCK_DGRAM) as link:
        link.settimeout(patience)
        link.connect(resolved)
        link.send(_QUIC_UNKNOWN)
        link.recv(2048)
