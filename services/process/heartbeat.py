"""Write once a second how far each loop of a service is, for `services.health` and for systemd."""

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

log = logging.getLogger(__name__)

EVERY = 1.0


class Turning(Protocol):
    """Something that completes one piece of work after the other, as `services.process.loop.Loop` does.

    Attributes:
        name: For people.
        rate: About how often it completes one [Hz].
    """

    name: str
    rate: float

    @property
    def done(self) -> int:
        """How many pieces of work were completed."""
        ...

    @property
    def error(self) -> str:
        """Why none is being completed, if that is known; else empty."""
        ...


class Heartbeat:
    """Writes once a second who this process is and when each of its loops was last seen to complete something.

    A context manager; the file is there while it lasts, and after a kill. The thread only looks at numbers: what is
    stuck cannot hold it up. Under systemd it also says `READY=1`, and `WATCHDOG=1` as long as all is well.

    Args:
        service: The service's name.
        robot: The robot's name.
        turning: What has to go on.
    """

    def __init__(self, service: str, robot: str, turning: Sequence[Turning]) -> None:
        self._path = heartbeat_path(service, robot)
        self._turning = turning
        self._seen: dict[str, tuple[int, float]] = {}
        self._stop = threading.Event()
        self._failed = False

    def __enter__(self) -> Self:
        self._beat()
        _tell_systemd("READY=1")
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        _tell_systemd("STOPPING=1")
        with contextlib.suppress(OSError):
            self._path.unlink()

    def _run(self) -> None:
        while not self._stop.wait(EVERY):
            found = self._beat()
            if not judge(found, time.monotonic()):
                _tell_systemd("WATCHDOG=1")

    def _beat(self) -> dict[str, Any]:
        now = time.monotonic()
        for one in self._turning:
            done = one.done
            if one.name not in self._seen or done != self._seen[one.name][0]:
                self._seen[one.name] = (done, now)
        found = {
            "pid": os.getpid(),
            "space": pid_space(),
            "started": started(os.getpid()),
            "boot": this_boot(),
            "stamp": now,
            "loops": {
                one.name: {"done": self._seen[one.name][0], "at": self._seen[one.name][1], "period": 1.0 / one.rate,
                           "error": one.error}
                for one in self._turning
            },
        }  # fmt: skip
        self._write(json.dumps(found))
        return found

    def _write(self, text: str) -> None:
        """Replace the file whole; a reader never sees half of one."""
        try:
            part = self._path.with_suffix(f".{os.getpid()}.part")
            part.write_text(text)
            part.replace(self._path)
            self._failed = False
        except OSError as error:
            if not self._failed:
                log.warning("No heartbeat in '%s': %s. Health checks will fail.", self._path, error.strerror)
            self._failed = True


def _tell_systemd(text: str) -> None:
    """Send a word to the service manager, if it asked for one (sd_notify)."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as told:
        told.connect("\0" + address[1:] if address.startswith("@") else address)
        told.setblocking(False)
        told.send(text.encode())
