"""Page in the browser that plays along with the demo: `gemuco view` as a child process."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from services.process.supervisor import Supervisor, gemuco_command

READY_WITHIN = 60.0
"""The page must be served within this time [s], also on a busy machine."""


@contextmanager
def playing_along(path: Path, out: Path) -> Iterator[str]:
    """Serve the page of a robot file on any free port until the block ends; yield its link.

    Raises:
        ChildDied: The page ended.
        NotReady: It was not served in time.
    """
    with Supervisor(out) as supervisor:
        log = supervisor.start("view", gemuco_command("view", str(path), "--port", "0")).log
        supervisor.wait_ready("view", lambda: bool(link_in(log)), READY_WITHIN)
        yield link_in(log)


def link_in(log: Path) -> str:
    """Return the link that `gemuco view` printed into its log; empty before."""
    text = log.read_text(errors="replace") if log.exists() else ""
    whole, _, _ = text.rpartition("\n")
    return next((word for word in whole.split() if word.startswith("http://")), "")
