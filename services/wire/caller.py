"""Who asks: a name for people, a number for programs, and the sample it has seen, carried beside every question."""

import getpass
import os
import socket
from contextvars import ContextVar
from dataclasses import dataclass

from services.wire.plain_text import plain

LONGEST_NAME = 80


@dataclass(frozen=True, slots=True)
class Caller:
    """Who asks a verb or commands.

    Attributes:
        name: For people, such as `anna@workstation (pid 4711)`; empty if the caller does not tell.
        boot: The caller's `boot`, as in its messages; 0 if it does not tell.
        through: `boot` of the service that asks on the caller's behalf; 0 if the caller asks itself.
        hal_boot: `Sample.boot` of the newest sample that whoever asks had seen then; 0 if it does not tell.
        cycle: `Sample.cycle` of that sample.
    """

    name: str = ""
    boot: int = 0
    through: int = 0
    hal_boot: int = 0
    cycle: int = 0

    def __str__(self) -> str:
        return self.name or (f"client {self.boot}" if self.boot else "somebody who does not tell a name")


def own_name() -> str:
    """The name of this process: user, host and pid."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container's user has no entry
        user = str(os.getuid())
    return plain(f"{user}@{socket.gethostname()} (pid {os.getpid()})", LONGEST_NAME)


UNKNOWN = Caller()
ASKING: ContextVar[Caller] = ContextVar("asking", default=UNKNOWN)
"""Who asks the verb that is being answered in this thread."""
