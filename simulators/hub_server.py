"""Server of a hub channel: it sends every frame to all other clients, at once or with the timing of a real bus."""

import contextlib
import fcntl
import logging
import os
import select
import socket
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import can

from hal.protocols.can_frames import FD_SIZES
from simulators.hub_socket import HELLOS, IS_FD, RECORD, RECORD_FD, RECORDS, mode_of, socket_path
from simulators.wire_time import ERROR, Wire

_log = logging.getLogger(__name__)

_BACKLOG = 100_000
"""A client with more waiting frames than this is disconnected: ten seconds of a full 1 Mbit/s bus."""
_QUEUE = 256
"""A timed bus accepts no frames of a program while this number of its frames waits. Each program has its own queue, as
each controller has: one that talks all the time does not keep urgent frames of others from the arbitration."""
_GRAIN = 3e-4
"""While frames wait, a timed bus sleeps at least this time [s]. Two or three frames then leave together, at half the
cost."""


@dataclass(eq=False, slots=True)
class _Client:
    socket: socket.socket
    outbox: bytearray = field(default_factory=bytearray)


class HubServer:
    """Server of one channel, with its own thread.

    Without a bit rate a frame is sent to the other clients at once. With a bit rate, frames wait for arbitration, the
    lowest identifier first. They are sent, and stamped, at the time of their last bit on a real bus.
    """

    def __init__(self, channel: str, bitrate: int | None = None, data_bitrate: int | None = None) -> None:
        """Prepare a server.

        Args:
            channel: Name of the channel, or the absolute path of its socket.
            bitrate: Simulated bit rate [bit/s]; None for no delay.
            data_bitrate: Bit rate of the data of CAN FD frames [bit/s]; None for a channel of classic frames only.
        """
        self.channel = channel
        self._path = socket_path(channel)
        self._record = RECORD_FD if data_bitrate else RECORD
        self._hello = next(hello for hello, record in HELLOS.items() if record is self._record)
        self._largest = RECORDS * self._record.size
        self._wire = Wire(bitrate, data_bitrate) if bitrate else None
        self._clients: list[_Client] = []
        self._thread: threading.Thread | None = None
        self._counters = {"frames": 0, "joined": 0, "cut_off": 0, "malformed": 0}

    def start(self) -> None:
        """Open the channel, so that programs can join.

        Raises:
            can.CanInitializationError: Another server has the channel, or its folder is not ours.
        """
        self._lock = _claim(self._path, self.channel)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._path.unlink(missing_ok=True)
        os.fchmod(self._listener.fileno(), mode_of(self._path))  # the file has at most this mode from the beginning
        self._listener.bind(str(self._path))
        self._path.chmod(mode_of(self._path))  # also what umask took
        self._listener.listen(64)
        self._listener.setblocking(False)
        self._waker, self._wake = socket.socketpair()
        self._thread = threading.Thread(target=self._serve, name=f"hub {self.channel}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close the channel; its clients get a CanOperationError. Safe to call twice."""
        if self._thread is None:
            return
        self._waker.send(b"x")
        self._thread.join()
        self._thread = None
        for part in (self._listener, self._waker, self._wake, *(client.socket for client in self._clients)):
            part.close()
        self._clients.clear()
        self._path.unlink(missing_ok=True)
        _lock_path(self._path).unlink(missing_ok=True)
        os.close(self._lock)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def stats(self) -> dict[str, float]:
        """Return counters since the start: frames, joined, cut_off, malformed; clients now; busy [s] of a timed bus."""
        busy = {"busy": self._wire.busy} if self._wire is not None else {}
        return {**self._counters, "clients": len(self._clients), **busy}

    def _serve(self) -> None:
        while True:
            senders = {client.socket: client for client in self._clients if not self._is_full(client)}
            readers = [client.socket for client in self._clients if client.outbox]
            ready, _, _ = select.select([self._wake, self._listener, *senders], readers, [], self._pause())
            if self._wake in ready:
                return
            for part in ready:
                if part is self._listener:
                    self._admit()
                else:
                    self._take(senders[part])
            if self._wire is not None:
                for sender, record, end in self._wire.advance(time.monotonic()):
                    self._share(sender, self._restamp(record, end))
            for client in list(self._clients):
                self._flush(client)

    def _is_full(self, client: _Client) -> bool:
        return self._wire is not None and self._wire.waiting_of(client) >= _QUEUE

    def _pause(self) -> float | None:
        if self._wire is None or (due := self._wire.due()) is None:
            return None
        return max(due - time.monotonic(), _GRAIN if len(self._wire) else 0.0)

    def _admit(self) -> None:
        with contextlib.suppress(OSError):  # the program may have ended already
            peer, _ = self._listener.accept()
            peer.setblocking(False)
            peer.send(self._hello, socket.MSG_NOSIGNAL)
            self._clients.append(_Client(peer))
            self._counters["joined"] += 1

    def _take(self, client: _Client) -> None:
        for _ in range(64):  # then serve the other clients
            if self._is_full(client):
                return
            try:
                packet = client.socket.recv(self._largest)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self._drop(client)
                return
            if len(packet) % self._record.size:
                self._refuse(client, "a packet of a wrong size")
                return
            self._counters["frames"] += len(packet) // self._record.size
            if self._wire is None:
                self._share(client, packet)
            else:
                self._queue(self._wire, client, packet)

    def _queue(self, wire: Wire, client: _Client, packet: bytes) -> None:
        now, size = time.monotonic(), self._record.size
        for start in range(0, len(packet), size):
            record = packet[start : start + size]
            identifier, length, _, data = self._record.unpack(record)
            if identifier & ERROR:
                self._share(client, record)
            elif length & IS_FD:
                if length & ~IS_FD not in FD_SIZES:
                    self._refuse(client, "a frame of CAN FD with a length that there is not")
                    return
                wire.push_fd(now, client, identifier, data[: length & ~IS_FD], record)
            else:
                wire.push(now, client, identifier, data[:length], min(length, 8), record)

    def _restamp(self, record: bytes, end: float) -> bytes:
        identifier, length, _, data = self._record.unpack(record)
        return self._record.pack(identifier, length, time.time() - time.monotonic() + end, data)

    def _share(self, sender: object, records: bytes) -> None:
        for client in self._clients:
            if client is not sender:
                client.outbox += records

    def _flush(self, client: _Client) -> None:
        while client.outbox:
            try:
                sent = client.socket.send(client.outbox[: self._largest], socket.MSG_NOSIGNAL)
            except BlockingIOError:
                break
            except OSError:
                self._drop(client)
                return
            del client.outbox[:sent]
        if len(client.outbox) > _BACKLOG * self._record.size:
            self._counters["cut_off"] += 1
            _log.warning("hub %s: disconnected a client that does not read", self.channel)
            self._drop(client)

    def _refuse(self, client: _Client, what: str) -> None:
        self._counters["malformed"] += 1
        _log.warning("hub %s: disconnected a client that sent %s", self.channel, what)
        self._drop(client)

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
        client.socket.close()


def _lock_path(path: Path) -> Path:
    return path.with_name(path.name + ".lock")


def _claim(path: Path, channel: str) -> int:
    """Lock a channel for this process. The lock ends with the process, also after a crash."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    while True:
        try:
            lock = os.open(_lock_path(path), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise can.CanInitializationError(
                f"Hub channel '{channel}' cannot be served from '{path.parent}': {error.strerror}. Is the folder yours?"
            ) from None
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            raise can.CanInitializationError(
                f"Hub channel '{channel}' is already served ({path}). Is another simulator running?"
            ) from None
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(lock).st_ino == _lock_path(path).stat().st_ino:
                return lock
        os.close(lock)  # the previous owner removed the file after this process opened it
