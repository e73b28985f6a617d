"""A client's lease of a robot, renewed in the background."""

import logging
import threading
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Protocol, Self

from services.command.lease import new_number
from services.errors import CommandHeld, LeaseLost, NoAnswer, ServiceError, TooLate

log = logging.getLogger(__name__)

SECONDS = 3.0
"""A lease has this length [s] by default: it survives a short delay and ends soon after its holder was killed."""
RENEWALS = 3
"""A lease is renewed this many times during its length, so two renewals may be lost."""
RELEASE_TIMEOUT = 1.0
"""The client waits at most this long [s] for the HAL to end the lease; without an answer the lease expires."""
NEEDS_LEASE = {
    "hal": ("enable", "reset", "home", "tare"),
    "model": ("engage", "target", "adapt", "rollback", "normal"),
}
"""These verbs of each service are refused while another client has the lease, and after the caller lost its lease."""


class LeaseLink(Protocol):
    """The methods of a client that a lease needs."""

    held_lease: "ClientLease | None"

    def ask(self, service: str, verb: str, arguments: Mapping[str, Any] | None = None, timeout: float = ...) -> Any:
        """Query a verb of a service."""
        ...


class ClientLease:
    """The lease of a robot, as a context manager: only its holder commands the robot; every client may stop the robot.

    The lease is lost if it was not renewed in time or the HAL was restarted. Then commands, and verbs that need the
    lease, raise `LeaseLost` until the end of the context. This process ends the lease earlier than the HAL does.

    Args:
        client: The client that takes the lease.
        seconds: Length of the lease without a renewal [s]; if this process dies, other clients wait this long.
    """

    def __init__(self, client: LeaseLink, seconds: float = SECONDS) -> None:
        self._client, self._seconds = client, seconds
        self._number = new_number()
        self._end = 0.0
        self._lost_text = ""
        self._renewal_fault = ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)

    def __enter__(self) -> Self:
        """Take the lease.

        Raises:
            CommandHeld: Another client has the lease; the text names this client.
            NoAnswer: The HAL does not answer.
            BadArguments: The length is not allowed.
        """
        if self._client.held_lease is not None:
            raise CommandHeld("This client already has the lease of this robot; one lease is enough.")
        request_time = time.monotonic()
        self._client.ask("hal", "lease", {"seconds": self._seconds, "number": self._number, "new": True})
        self._end = request_time + self._seconds
        self._client.held_lease = self
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.held_lease = None
        self._stop.set()
        self._thread.join(RELEASE_TIMEOUT)
        try:
            self._client.ask("hal", "release", {"number": self._number}, RELEASE_TIMEOUT)
        except ServiceError as failure:
            log.warning("The lease could not be released; it expires by itself: %s", failure)

    @property
    def text(self) -> str:
        """The reason why the lease was lost; empty while it runs."""
        if not self._lost_text and time.monotonic() >= self._end:
            self._lose(f"the lease was not renewed for {self._seconds:g} s. {self._renewal_fault}")
        return self._lost_text

    def check(self) -> None:
        """Raise `LeaseLost` if the lease was lost."""
        if text := self.text:
            raise LeaseLost(text)

    def _lose(self, reason: str) -> None:
        self._lost_text = self._lost_text or f"This client no longer commands the robot: {reason}".rstrip()

    def _renew(self) -> None:
        pause = self._seconds / RENEWALS
        while not self._stop.wait(pause) and not self.text:
            request_time = time.monotonic()
            arguments = {"seconds": self._seconds, "number": self._number}
            try:
                self._client.ask("hal", "lease", arguments, min(pause, self._end - request_time))
            except (NoAnswer, TooLate) as error:
                self._renewal_fault = str(error)
            except Exception as error:  # after any other error this client must not command
                self._lose(str(error))
            else:
                self._renewal_fault, self._end = "", request_time + self._seconds
