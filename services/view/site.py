"""Web server of the page: viser on loopback, closed to pages of another origin and to publishing."""

import functools
import logging
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from services.errors import ServiceError
from services.extras import require
from services.wire.session import is_loopback

if TYPE_CHECKING:
    import viser

LOOPBACK_PAGES = re.compile(r"http://(127\.\d+\.\d+\.\d+|localhost|\[::1\])(:\d+)?")
"""Only pages of these origins may connect to a server on loopback; other pages in the same browser may not."""


def open_site(host: str, port: int, title: str) -> "viser.ViserServer":
    """Serve an empty page.

    Args:
        host: Address to bind.
        port: Port to bind; 0 for any.
        title: Title of the page.

    Raises:
        ServiceError: The packages are not installed, the port is taken, or this machine does not have the address.
    """
    require("viser", "yourdfpy")
    import rich
    import viser
    from viser import _messages

    _check_free(host, port)
    rich.get_console().quiet = True  # viser prints a table to stdout
    for name in ("websockets", "websockets.server"):  # else one traceback per browser that disconnects
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with _only_pages(LOOPBACK_PAGES if is_loopback(host) else None):
        site = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    if port and site.get_port() != port:  # viser takes the next free one
        site.stop()
        raise ServiceError(_taken(host, port))
    # This request of a browser would publish the page on the internet.
    site._websock_server.unregister_handler(_messages.ShareUrlRequest)
    return site


@contextmanager
def _only_pages(allowed: "re.Pattern[str] | None") -> Iterator[None]:
    """Let viser's server refuse connections of other pages; viser has no option for it."""
    from websockets.asyncio import server

    whole = server.serve
    origins = None if allowed is None else [None, allowed]
    server.serve = functools.partial(whole, origins=origins)  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        server.serve = whole  # type: ignore[misc]


def _check_free(host: str, port: int) -> None:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except socket.gaierror:
            raise ServiceError(f"'{host}' is not a known address.") from None
        except PermissionError:
            raise ServiceError(f"Port {port} needs root; take one above 1023 with --port.") from None
        except OSError as error:
            if error.errno == 98:  # EADDRINUSE
                raise ServiceError(_taken(host, port)) from None
            raise ServiceError(f"The page cannot be served on {host}:{port}: {error.strerror}.") from None


def _taken(host: str, port: int) -> str:
    return (
        f"Port {port} on {host} is taken by another process. Choose another one with --port, or see which it is with "
        f"`ss -ltnp 'sport = :{port}'`."
    )
