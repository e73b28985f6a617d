"""To command a robot: a lease that is renewed in the background, and lost loudly."""

import logging
import threading
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Protocol, Self

from services.errors import CommandHeld, LeaseLost, NoAnswer, ServiceError, TooLate

log = logging.getLogger(__name__)

SECONDS = 3.0
"""A lease [s] that outlives a slow moment, and does not keep others out for long after its holder was killed."""
RENEWALS = 3
"""How often a lease is renewed in its time: two may be lost."""
BACK_WITHIN = 1.0
"""How long [s] to wait for the HAL to take the lease back; it runs out by itself."""
NEEDS_LEASE = {
    "hal": ("enable", "reset", "home", "tare"),
    "model": ("engage", "target", "adapt", "rollback", "normal"),
}
"""Service -> verbs that are refused while somebody else commands, and while the one who asks has lost its lease."""


class Robot(Protocol):
    """What a lease needs of a client."""

    commanding: "Commanding | None"

    def ask(self, service: str, verb: str, arguments: Mapping[str, Any] | None = None, timeout: float = ...) -> Any:
        """Ask any verb of any service."""
        ...


class Commanding:
    """The lease of a robot, as a context manager: nobody else commands meanwhile, and everybody may stop it.

    After it was lost, commands and verbs that need it raise `LeaseLost`, until the end of the context. It was lost when
    it could not be renewed in time, or the HAL was restarted; by the clock of this process before that of the HAL.

    Args:
        robot: The client that is to command.
        seconds: How long it runs without being renewed; shorter is sooner free for others after this process died.
    """

    def __init__(self, robot: Robot, seconds: float = SECONDS) -> None:
        self._robot, self._seconds = robot, seconds
        self._number = 0
        self._until = 0.0
        self._lost = ""
        self._trouble = ""
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)

    def __enter__(self) -> Self:
        """Take the lease.

        Raises:
            CommandHeld: Somebody else commands; the text names the holder.
            NoAnswer: No HAL answers.
            BadArguments: Not a time that a lease may have.
        """
        if self._robot.commanding is not None:
            raise CommandHeld("This client commands the robot already; one lease is enough.")
        asked = time.monotonic()
        answer = self._robot.ask("hal", "lease", {"seconds": self._seconds})
        self._number, self._until = answer["number"], asked + self._seconds
        self._robot.commanding = self
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._robot.commanding = None
        self._done.set()
        self._thread.join(BACK_WITHIN)
        try:
            self._robot.ask("hal", "release", timeout=BACK_WITHIN)
        except ServiceError as failure:
            log.warning("The lease was not given back, and runs out by itself: %s", failure)

    @property
    def text(self) -> str:
        """Why the lease was lost; empty while it runs."""
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
                self._robot.ask("hal", "lease", arguments, min(pause, self._until - asked))
            except (NoAnswer, TooLate) as error:
                self._trouble = str(error)
            except Exception as error:  # whatever it is, this client must not believe that it commands
                self._lose(str(error))
            else:
                self._trouble, self._until = "", asked + self._seconds
