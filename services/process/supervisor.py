"""Child processes that never outlive their parent: each has its own group, is watched, and is stopped in time."""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from services.errors import ServiceError

_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None, use_errno=True)
LAST_LINES = 5
POLL = 0.05


def gemuco_command(*arguments: str) -> list[str]:
    """Return the command line of a verb of gemuco."""
    return [sys.executable, "-m", "services.cli", *arguments]


class ChildDied(ServiceError):
    """A supervised process that ended by itself; the text gives its exit and its last output."""


class NotReady(ServiceError):
    """A supervised process that did not become ready in time."""


@dataclass(slots=True)
class Child:
    """A supervised process."""

    name: str
    command: tuple[str, ...]
    log: Path
    process: subprocess.Popen[bytes]

    def ended(self) -> str:
        """Return its exit and its last output in one sentence; empty while it runs."""
        code = self.process.poll()
        if code is None:
            return ""
        exit_text = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"exited with {code}"
        lines = " / ".join(line.strip() for line in self.log.read_text(errors="replace").splitlines()[-LAST_LINES:])
        return f"'{self.name}' {exit_text}. Its last output: {lines or 'none'}. The whole output is in {self.log}."


class Supervisor:
    """A context manager that starts children and stops them all when this process ends for any reason.

    A child gets its own session, so that Ctrl-C in the terminal reaches only the supervisor, which stops the children
    in the reverse order of their start. The kernel ends a child when the supervisor is killed.
    """

    def __init__(self, folder: Path, grace: float = 5.0, at_checks: bool = False) -> None:
        """Prepare.

        Args:
            folder: Logs go to `folder/<name>.log`.
            grace: A child that ignores SIGTERM for this time [s] is killed.
            at_checks: Obey Ctrl-C and SIGTERM only in `check`, which must then be called often: an exception at any
                other point can leave a lock held, and another thread would wait for it for ever. A second signal acts
                at once.
        """
        self.folder = folder
        self.grace = grace
        self.at_checks = at_checks
        self._signal: int | None = None
        self.children: dict[str, Child] = {}
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> "Supervisor":
        """Turn SIGTERM and SIGHUP into `SystemExit`, so that leaving the block stops the children."""
        self.folder.mkdir(parents=True, exist_ok=True)
        numbers = [signal.SIGTERM, signal.SIGHUP]
        if self.at_checks and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            numbers.append(signal.SIGINT)
        for number in numbers:
            self._handlers[number] = signal.signal(number, self._note if self.at_checks else _leave)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.stop_all()
        finally:
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
        if error is None:
            self._obey()

    def start(self, name: str, command: Sequence[str]) -> Child:
        """Start a process; call from the main thread, whose death ends the child."""
        log = self.folder / f"{name}.log"
        with log.open("wb") as sink:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=die_with(os.getpid()),
                env={**os.environ, "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        child = Child(name, tuple(command), log, process)
        self.children[name] = child
        return child

    def wait_ready(self, name: str, is_ready: Callable[[], bool], timeout: float) -> None:
        """Block until `is_ready()`.

        Raises:
            ChildDied: A child ended meanwhile.
            NotReady: The time [s] is over.
        """
        deadline = time.monotonic() + timeout
        while not is_ready():
            self.check()
            if time.monotonic() > deadline:
                log = self.children[name].log
                raise NotReady(f"'{name}' was not ready within {timeout:g} s. Its output is in {log}.")
            time.sleep(POLL)

    def check(self) -> None:
        """Raise `ChildDied` if a child has ended by itself, or the exception of a signal that came meanwhile."""
        self._obey()
        for child in self.children.values():
            if text := child.ended():
                raise ChildDied(text)

    def _note(self, number: int, frame: FrameType | None) -> None:
        is_second, self._signal = self._signal is not None, number
        if is_second:
            self._obey()

    def _obey(self) -> None:
        number, self._signal = self._signal, None
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        if number is not None:
            raise SystemExit(128 + number)

    def kill(self, name: str) -> None:
        """Kill a child (SIGKILL), as a crash would, and remove it."""
        child = self.children.pop(name)
        _signal_group(child.process, signal.SIGKILL)
        child.process.wait()

    def stop(self, *names: str) -> None:
        """Ask children to end, one after the other, and kill those that still run after the grace time."""
        for child in [self.children[name] for name in names if name in self.children]:
            _signal_group(child.process, signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.process.wait(self.grace)
            _signal_group(child.process, signal.SIGKILL)
            child.process.wait()
            del self.children[child.name]

    def stop_all(self) -> None:
        """Stop every child, the last started first; a second Ctrl-C meanwhile kills them."""
        try:
            self.stop(*reversed(self.children))
        except BaseException:
            for name in list(self.children):
                self.kill(name)
            raise


def _leave(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)
    raise SystemExit(128 + number)


def die_with(parent: int) -> Callable[[], None]:
    """Return a `preexec_fn` with which the kernel ends the child with its parent."""

    def in_child() -> None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # the parent died between fork and prctl
            os._exit(1)

    return in_child


def _signal_group(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """Send a signal to the child's whole process group, which it leads."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
