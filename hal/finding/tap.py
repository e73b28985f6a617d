"""Receiver of every frame of a bus with the interface's own time stamp; it sends only on request.

Beside a running HAL it needs an interface that several programs can open: socketcan, hub, udp_multicast.
"""

import math
import queue
import threading
import time
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Self

import can

from hal.config import BusConfig
from hal.errors import BusGone, ConfigError
from hal.finding.book import Frame
from hal.wire.interface import open_interface

POLL = 0.1
"""A reader checks with this period [s] whether it must end."""


class Tap:
    """One interface that is open while the context lasts.

    Args:
        name: Name of the bus in messages.
        config: Interface and channel of the bus.
    """

    def __init__(self, name: str, config: BusConfig) -> None:
        if config.interface not in can.VALID_INTERFACES:
            known = ", ".join(sorted(can.VALID_INTERFACES))
            raise ConfigError(f"Interface '{config.interface}' is not known to python-can. Known: {known}.")
        self.name = name
        self.config = config
        self._can: can.BusABC | None = None

    def __enter__(self) -> Self:
        config = self.config
        try:
            self._can = open_interface(config)
        except Exception as error:  # an interface plugin may raise anything
            where, why = f"'{self.name}' ({config.interface} {config.channel})", str(error).rstrip(".")
            advice = "" if why.endswith("?") else ". Is it there, is it up?"
            raise BusGone(f"Bus {where} does not open: {why}{advice}") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._can is not None:
            self._can.shutdown()
            self._can = None

    def receive(self, timeout: float) -> Frame | None:
        """Return the next frame, or None if none arrives within `timeout` [s].

        Raises:
            BusGone: The interface failed.
        """
        assert self._can is not None, "the tap is not open"
        try:
            message = self._can.recv(timeout)
        except (can.CanError, OSError) as error:
            raise BusGone(f"Bus '{self.name}' failed: {error}. Is the interface up?") from error
        if message is None:
            return None
        return Frame(
            message.timestamp,
            message.arbitration_id,
            bytes(message.data),
            message.is_extended_id,
            message.is_remote_frame,
            message.is_error_frame,
            message.is_fd,
        )

    def send(self, identifier: int, data: bytes) -> None:
        """Send a frame with an 11-bit identifier.

        Raises:
            BusGone: The interface does not take the frame, as socketcan if no other node acknowledges frames.
        """
        assert self._can is not None, "the tap is not open"
        try:
            self._can.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False), timeout=0.05)
        except (can.CanError, OSError) as error:
            raise BusGone(
                f"Bus '{self.name}' takes no frames: {error}. Is another node powered, is the bus terminated, is the "
                "bit rate right?"
            ) from error


def frames(buses: Mapping[str, BusConfig], seconds: float = math.inf) -> Iterator[tuple[str, Frame]]:
    """Yield (name of the bus, frame) for all frames of some buses, in the order of reception here.

    Args:
        buses: Names, interfaces and channels of the buses.
        seconds: Duration [s].

    Raises:
        BusGone: A bus cannot be opened, or failed.
    """
    received: queue.Queue[tuple[str, Frame | BusGone]] = queue.Queue()
    stopping = threading.Event()
    threads = [
        threading.Thread(target=_listen, args=(name, config, received, stopping), name=f"tap {name}", daemon=True)
        for name, config in buses.items()
    ]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + seconds
    try:
        while (remaining := deadline - time.monotonic()) > 0:
            try:
                name, frame = received.get(timeout=min(remaining, POLL))
            except queue.Empty:
                continue
            if isinstance(frame, BusGone):
                raise frame
            yield name, frame
    finally:
        stopping.set()
        for thread in threads:
            thread.join()


def _listen(
    name: str, config: BusConfig, received: queue.Queue[tuple[str, Frame | BusGone]], stopping: threading.Event
) -> None:
    try:
        with Tap(name, config) as tap:
            while not stopping.is_set():
                frame = tap.receive(POLL)
                if frame is not None:
                    received.put((name, frame))
    except BusGone as error:
        received.put((name, error))
