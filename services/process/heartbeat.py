"""Write the progress of a service's loops once a second, for `services.health` and for systemd."""

import contextlib
import json
import logging
import os
import socket
import threading
import time
from collections.abc import Sequence
from typing import Any, Protocol, Self

from services.health import heartbeat_path, judge, pid_space, started, this_boot
from services.runtime import open_file

log = logging.getLogger(__name__)

EVERY = 1.0


class Activity(Protocol):
    """A repeated piece of work, such as a `services.process.loop.Loop`.

    Attributes:
        name: Name for people.
        rate: Approximate rate [Hz].
    """

    name: str
    rate: float

    @property
    def done(self) -> int:
        """Number of completed pieces of work."""
        ...

    @property
    def error(self) -> str:
        """Reason why none is completed, if known; else empty."""
        ...


class Heartbeat:
    """A context manager that writes once a second the identity of the process and the last progress of each loop.

    The file exists while the context lasts, and after a kill. The thread only reads numbers, so a stuck loop cannot
    block it. Under systemd it also sends `READY=1`, and `WATCHDOG=1` while all loops progress.

    Args:
        service: The service's name.
        robot: The robot's name.
        activities: The loops to watch.
    """

    def __init__(self, service: str, robot: str, activities: Sequence[Activity]) -> None:
        self._path = heartbeat_path(service, robot)
        self._activities = activities
        self._seen: dict[str, tuple[int, float]] = {}
        self._stop = threading.Event()
        self._failed = False

    def __enter__(self) -> Self:
        self._beat()
        _notify_systemd("READY=1")
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        _notify_systemd("STOPPING=1")
        with contextlib.suppress(OSError):
            self._path.unlink()

    def _run(self) -> None:
        while not self._stop.wait(EVERY):
            if not judge(self._beat(), time.monotonic()):
                _notify_systemd("WATCHDOG=1")

    def _beat(self) -> dict[str, Any]:
        now = time.monotonic()
        for activity in self._activities:
            done = activity.done
            if activity.name not in self._seen or done != self._seen[activity.name][0]:
                self._seen[activity.name] = (done, now)
        content = {
            "pid": os.getpid(),
            "space": pid_space(),
            "started": started(os.getpid()),
            "boot": this_boot(),
            "stamp": now,
            "loops": {
                a.name: {"done": self._seen[a.name][0], "at": self._seen[a.name][1], "period": 1.0 / a.rate,
                         "error": a.error}
                for a in self._activities
            },
        }  # fmt: skip
        self._write(json.dumps(content))
        return content

    def _write(self, text: str) -> None:
        """Replace the whole file at once, so that a reader never sees half of it."""
        try:
            part = self._path.with_suffix(f".{os.getpid()}.part")
            with open(part, "w", opener=open_file) as file:
                file.write(text)
            part.replace(self._path)
            self._failed = False
        except OSError as error:
            if not self._failed:
                log.warning("No heartbeat in '%s': %s. Health checks will fail.", self._path, error.strerror)
            self._failed = True


def _notify_systemd(text: str) -> None:
    """Send a notification to the service manager, if it asks for them (sd_notify)."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as link:
        link.connect("\0" + address[1:] if address.startswith("@") else address)
        link.setblocking(False)
        link.send(text.encode())
