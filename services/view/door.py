"""The door of the page: the link's token, the origin with its port, and no frame of another page.

The token is a part of the path and not a cookie: cookies do not know ports, so a browser would send them to every other
web server of the same machine.
"""

import gzip
import hmac
import re
import secrets
from collections.abc import Callable
from dataclasses import replace
from http import HTTPStatus
from typing import TYPE_CHECKING

from services.view.styles import ALIVE, with_ending
from services.wire.session import is_loopback

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    Process = Callable[[ServerConnection, Request], Response | None]

HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Every answer has these headers: no page may frame this one, and its link is in no request to elsewhere."""
LOOPBACK = re.compile(r"(127\.\d+\.\d+\.\d+|localhost|\[::1\])(:\d+)?")


def new_token() -> str:
    """Return a secret for a link."""
    return secrets.token_urlsafe(24)


class Door:
    """Decision on every request to a server of a page.

    Args:
        host: Address to which the server is bound.
        token: Path of the page; empty if no secret is needed, as for a page that is read only.
        elsewhere: Returns the port of the page for requests without the token.
    """

    def __init__(self, host: str, token: str = "", elsewhere: Callable[[], int] | None = None) -> None:
        self._is_local, self._token, self._elsewhere = is_loopback(host), token, elsewhere
        self.is_open = False
        """Whether requests are answered at all. viser accepts browsers before it can serve them."""
        self._page: tuple[bytes, bytes] = b"", b""
        """The last page as viser sends it, and as it is sent from here."""

    def guard(self, process: "Process | None") -> "Process":
        """Return the function that answers a request here, or hands it to `process`; None opens a websocket."""

        def guarded(connection: "ServerConnection", request: "Request") -> "Response | None":
            response = self._refusal(connection, request)
            path = self._path_below(request.path) or "/"
            if response is None and path == ALIVE:
                response = connection.respond(HTTPStatus.OK, "alive\n")
            elif response is None:
                request = replace(request, path=path)
                response = process(connection, request) if process is not None else None
                if response is not None and response.headers.get("Content-Type", "").startswith("text/html"):
                    self._add_ending(response)
            if response is not None:
                for name, value in HEADERS.items():
                    response.headers[name] = value
            return response

        return guarded

    def _add_ending(self, response: "Response") -> None:
        """Add the words for the end of the program to a page."""
        body = bytes(response.body)
        if body != self._page[0]:
            is_packed = response.headers.get("Content-Encoding") == "gzip"
            whole = with_ending(gzip.decompress(body) if is_packed else body)
            self._page = body, gzip.compress(whole) if is_packed else whole
        response.body = self._page[1]
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))

    def _refusal(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        host = request.headers.get("Host", "")
        if self._is_local and not LOOPBACK.fullmatch(host):  # a foreign name that was made to mean this machine
            return connection.respond(HTTPStatus.FORBIDDEN, "This page is served to this machine under its own name.\n")
        if not self.is_open:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "The page starts. Try again in a second.\n")
        is_socket = request.headers.get("Upgrade", "").lower() == "websocket"
        origin = request.headers.get("Origin")
        if is_socket and origin is not None and origin.partition("://")[2] != host:
            return connection.respond(HTTPStatus.FORBIDDEN, "A page of another origin may not connect.\n")
        if self._path_below(request.path) is not None:
            return None
        if is_socket or self._elsewhere is None:
            return connection.respond(HTTPStatus.FORBIDDEN, "Open the link that `gemuco view` printed.\n")
        response = connection.respond(
            HTTPStatus.SEE_OTHER, "Without the link of `gemuco view` the page is read only.\n"
        )
        name = host.rpartition(":")[0] if re.search(r":\d+$", host) else host
        response.headers["Location"] = f"http://{name}:{self._elsewhere()}/"
        return response

    def _path_below(self, path: str) -> str | None:
        """Return the path behind the token; None without it."""
        if not self._token:
            return path
        first, _, rest = path.partition("?")[0].removeprefix("/").partition("/")
        return f"/{rest}" if hmac.compare_digest(first.encode(), self._token.encode()) else None
