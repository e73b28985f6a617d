"""The caller of a verb: a name for people, a number for programs, and the newest sample that it has seen."""

import getpass
import os
import socket
from contextvars import ContextVar
from dataclasses import dataclass

from services.wire.plain_text import plain

LONGEST_NAME = 80


@dataclass(frozen=True, slots=True)
class Caller:
    """The sender of a query or a command. A field that it did not send is empty or 0.

    Attributes:
        name: For people, such as `anna@workstation (pid 4711)`.
        boot: The caller's `boot`, as in its messages.
        through: `boot` of the service that asks on the caller's behalf; 0 if the caller asks itself.
        hal_boot: `Sample.boot` of the newest sample that the caller had seen.
        cycle: `Sample.cycle` of that sample.
    """

    name: str = ""
    boot: int = 0
    through: int = 0
    hal_boot: int = 0
    cycle: int = 0

    def __str__(self) -> str:
        return self.name or (f"client {self.boot}" if self.boot else "a client without a name")


def own_name() -> str:
    """Return the name of this process: user, host and pid."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container's user has no entry
        user = str(os.getuid())
    return plain(f"{user}@{socket.gethostname()} (pid {os.getpid()})", LONGEST_NAME)


UNKNOWN = Caller()
CURRENT_CALLER: ContextVar[Caller] = ContextVar("current_caller", default=UNKNOWN)
"""This is the caller of the verb that the current thread is answering."""
