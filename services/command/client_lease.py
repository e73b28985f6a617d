"""A client's lease of a robot, renewed in the background."""

import logging
import threading
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Protocol, Self

from services.errors import CommandHeld, LeaseLost, NoAnswer, ServiceError, TooLate

log = logging.getLogger(__name__)

SECONDS = 3.0
"""Default length of a lease [s]: it outlives a slow moment, and ends soon after its holder was killed."""
RENEWALS = 3
"""A lease is renewed this many times in its length: two renewals may be lost."""
BACK_WITHIN = 1.0
"""Longest wait [s] for the HAL to take the lease back; it also runs out by itself."""
NEEDS_LEASE = {
    "hal": ("enable", "reset", "home", "tare"),
    "model": ("engage", "target", "adapt", "rollback", "normal"),
}
"""Service -> verbs that are refused while another client commands, and after the caller has lost its lease."""


class Asker(Protocol):
    """The part of a client that a lease needs."""

    held_lease: "ClientLease | None"

    def ask(self, service: str, verb: str, arguments: Mapping[str, Any] | None = None, timeout: float = ...) -> Any:
        """Ask a verb of a service."""
        ...


class ClientLease:
    """The lease of a robot, as a context manager: no other client commands meanwhile; every client may stop the robot.

    A lease that could not be renewed in time, or whose HAL was restarted, is lost: until the end of the context
    commands and verbs that need it raise `LeaseLost`. By the clock of this process it ends before it does in the HAL.

    Args:
        client: The client that is to command.
        seconds: Time [s] that it runs without renewal; a short one is free for others soon after this process died.
    """

    def __init__(self, client: Asker, seconds: float = SECONDS) -> None:
        self._client, self._seconds = client, seconds
        self._number = 0
        self._until = 0.0
        self._lost = ""
        self._trouble = ""
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)

    def __enter__(self) -> Self:
        """Take the lease.

        Raises:
            CommandHeld: Another client commands; the text names it.
            NoAnswer: The HAL does not answer.
            BadArguments: The time is not allowed.
        """
        if self._client.held_lease is not None:
            raise CommandHeld("This client commands the robot already; one lease is enough.")
        asked = time.monotonic()
        answer = self._client.ask("hal", "lease", {"seconds": self._seconds})
        self._number, self._until = answer["number"], asked + self._seconds
        self._client.held_lease = self
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.held_lease = None
        self._done.set()
        self._thread.join(BACK_WITHIN)
        try:
            self._client.ask("hal", "release", timeout=BACK_WITHIN)
        except ServiceError as failure:
            log.warning("The lease was not given back, and runs out by itself: %s", failure)

    @property
    def text(self) -> str:
        """The reason why the lease was lost; empty while it runs."""
        if not self._lost and time.monotonic() >= self._until:
            self._lose(f"it was not renewed for {self._seconds:g} s. {self._trouble}")
        return self._lost

    def check(self) -> None:
        """Raise `LeaseLost` if the lease was lost."""
        if text := self.text:
            raise LeaseLost(text)

    def _lose(self, why: str) -> None:
        self._lost = self._lost or f"This client commands no more: {why}".rstrip()

    def _renew(self) -> None:
        pause = self._seconds / RENEWALS
        while not self._done.wait(pause) and not self.text:
            asked = time.monotonic()
            arguments = {"seconds": self._seconds, "number": self._number}
            try:
                self._client.ask("hal", "lease", arguments, min(pause, self._until - asked))
            except (NoAnswer, TooLate) as error:
                self._trouble = str(error)
            except Exception as error:  # whatever it is, this client must not go on to command
                self._lose(str(error))
            else:
                self._trouble, self._until = "", asked + self._seconds
