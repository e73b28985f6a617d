"""Every kind of bus that the tests can have without hardware: how a robot file names it, and whether it works here.

    @pytest.fixture(params=KINDS, ids=str)
    def section(request):
        request.param.skip_unless_it_works()
        with request.param.serve() as section:
            yield section  # {"interface": ..., "channel": ..., "options": ...}, as in buses.can0 of a robot file

Robot and simulated nodes both open `section`; `both_ends` opens it twice for a test that needs no robot.
"""

import contextlib
import functools
import itertools
import logging
import os
import selectors
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass

import can
import pytest

from simulators.hub import HubServer

Section = dict[str, object]
_numbers = itertools.count()


@dataclass(frozen=True)
class BusKind:
    """One kind of bus.

    Attributes:
        name: Of python-can's interface.
        serve: A bus of its own: what stands in a robot file for it, while the context lasts.
        delivers_late: Whether a frame may still be under way when `send` has returned.
        echoes: Whether a sender hears its own frames.
        served_by_rig: Whether a `Rig` runs the server that the bus needs; for a test without a rig, `both_ends` does.
    """

    name: str
    serve: Callable[[], AbstractContextManager[Section]]
    delivers_late: bool = True
    echoes: bool = False
    served_by_rig: bool = False

    def __str__(self) -> str:
        return self.name

    def skip_unless_it_works(self) -> None:
        """Skip the test, with the reason, where this machine cannot have such a bus."""
        reason = _why_not(self)
        if reason:
            pytest.skip(reason)


@contextlib.contextmanager
def both_ends(kind: BusKind) -> Iterator[tuple[can.BusABC, can.BusABC]]:
    """Two programs' places on a bus of this kind."""
    with contextlib.ExitStack() as stack:
        section = stack.enter_context(kind.serve())
        if kind.served_by_rig:
            server = HubServer(str(section["channel"]), None)
            server.start()
            stack.callback(server.close)
        ends = [open_end(section) for _ in range(2)]
        for end in ends:
            stack.callback(end.shutdown)
        yield ends[0], ends[1]


def open_end(section: Section) -> can.BusABC:
    """One more place on a bus that is served."""
    return can.Bus(channel=section["channel"], interface=section["interface"], **section.get("options", {}))  # type: ignore[arg-type]


@functools.cache
def _why_not(kind: BusKind) -> str:
    """Empty if a frame sent at one end arrives at the other."""
    try:
        with both_ends(kind) as (here, there):
            here.send(can.Message(arbitration_id=0x123, data=b"\x01\x02", is_extended_id=False))
            heard = there.recv(1.0)
    except (can.CanError, OSError) as error:
        return f"no {kind} bus on this machine: {error}"
    if heard is None or bytes(heard.data) != b"\x01\x02":
        return f"no {kind} bus on this machine: a frame does not arrive. Is there a route for it (224.0.0.0/4)?"
    return ""


@contextlib.contextmanager
def _in_process() -> Iterator[Section]:
    yield {"interface": "virtual", "channel": f"kind_{os.getpid()}_{next(_numbers)}"}


@contextlib.contextmanager
def _hub() -> Iterator[Section]:
    yield {"interface": "hub", "channel": f"kind_{os.getpid()}_{next(_numbers)}"}


@contextlib.contextmanager
def _multicast() -> Iterator[Section]:
    """A port of its own for each bus, and no hop, so that no frame leaves this machine."""
    port = 43200 + (os.getpid() * 7 + next(_numbers)) % 16000
    yield {"interface": "udp_multicast", "channel": "239.74.163.2", "options": {"port": port, "hop_limit": 0}}


@contextlib.contextmanager
def _daemon() -> Iterator[Section]:
    logging.getLogger("can.interfaces.socketcand").setLevel(logging.ERROR)  # it warns of every read that ends mid-frame
    server = SocketcandServer()
    try:
        options = {"host": "127.0.0.1", "port": server.port, "tcp_tune": True}
        yield {"interface": "socketcand", "channel": "can0", "options": options}
    finally:
        server.close()


class SocketcandServer:
    """A bus served over TCP, in the raw mode of the socketcand protocol (github.com/linux-can/socketcand)."""

    ADMISSION = 0.02
    """The client of python-can takes what follows `< ok >` for part of it: nothing follows for so long [s]."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._clients: dict[socket.socket, str] = {}
        self._listening: set[socket.socket] = set()
        self._waiting = selectors.DefaultSelector()
        self._waiting.register(self._listener, selectors.EVENT_READ)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="socketcand", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let go of every client."""
        self._closing.set()
        self._thread.join()
        for end in (self._listener, *self._clients):
            end.close()
        self._waiting.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            for key, _ in self._waiting.select(0.05):
                if key.fileobj is self._listener:
                    self._admit()
                else:
                    self._take(key.fileobj)  # type: ignore[arg-type]

    def _admit(self) -> None:
        client, _ = self._listener.accept()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients[client] = ""
        self._waiting.register(client, selectors.EVENT_READ)
        client.sendall(b"< hi >")

    def _take(self, client: socket.socket) -> None:
        try:
            received = client.recv(65536)
        except OSError:
            received = b""
        if not received:
            self._drop(client)
            return
        *whole, self._clients[client] = (self._clients[client] + received.decode("ascii")).split(">")
        for part in whole:
            self._obey(client, part.strip(" <").split())

    def _obey(self, client: socket.socket, words: list[str]) -> None:
        if words[0] in ("open", "rawmode"):
            client.sendall(b"< ok >")
            time.sleep(self.ADMISSION)
            if words[0] == "rawmode":
                self._listening.add(client)
        elif words[0] == "send":
            data = "".join(byte.zfill(2) for byte in words[3:])
            frame = f"< frame {words[1]} {time.time():.6f} {data} >".encode()
            for other in self._listening - {client}:
                try:
                    other.sendall(frame)
                except OSError:
                    self._drop(other)

    def _drop(self, client: socket.socket) -> None:
        self._waiting.unregister(client)
        del self._clients[client]
        self._listening.discard(client)
        client.close()


VIRTUAL = BusKind("virtual", _in_process, delivers_late=False)
HUB = BusKind("hub", _hub, served_by_rig=True)
UDP_MULTICAST = BusKind("udp_multicast", _multicast, echoes=True)
SOCKETCAND = BusKind("socketcand", _daemon)
KINDS = (VIRTUAL, HUB, UDP_MULTICAST, SOCKETCAND)
