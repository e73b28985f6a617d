"""Web server of the page: viser behind a `Door`, closed to publishing."""

import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from services.errors import ServiceError
from services.extras import require
from services.view.door import Door

if TYPE_CHECKING:
    import viser


def open_site(host: str, port: int, title: str, door: Door) -> "viser.ViserServer":
    """Serve an empty page.

    Args:
        host: Address to bind.
        port: Port to bind; 0 for any.
        title: Title of the page.
        door: Decision on every request.

    Raises:
        ServiceError: The packages are not installed, the port is taken, or this machine does not have the address.
    """
    require("viser", "yourdfpy")
    import rich
    import viser
    from viser import _messages

    _check_free(host, port)
    rich.get_console().quiet = True  # viser prints a table to stdout
    logging.getLogger("websockets.server").addFilter(is_news)
    with _behind(door):
        site = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    if port and site.get_port() != port:  # viser takes the next free one
        site.stop()
        raise ServiceError(_taken(host, port))
    # This request of a browser would publish the page on the internet.
    site._websock_server.unregister_handler(_messages.ShareUrlRequest)
    door.is_open = True
    return site


def is_news(record: logging.LogRecord) -> bool:
    """Whether a record of the server reports more than a browser that went away or is none."""
    from websockets.exceptions import WebSocketException

    error = record.exc_info[1] if record.exc_info else None
    return record.levelno >= logging.WARNING and not isinstance(error, WebSocketException | OSError | EOFError)


@contextmanager
def _behind(door: Door) -> Iterator[None]:
    """Let viser's server ask the door first; viser has no option for it."""
    from websockets.asyncio import server

    whole = server.serve

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        return whole(*arguments, process_request=door.guard(process_request), **options)

    server.serve = serve  # type: ignore[misc, assignment]
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
