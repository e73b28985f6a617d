"""A process that is stopped within its zenoh handshake is connected when it continues."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest

from services.wire.session import CLOSE_WITHIN, LEASE_MS, address, port, settings

_ROBOT = """
import sys, time
from services.wire import keys
from services.wire.session import open_with, settings
robot, listened = sys.argv[1:]
configuration = settings(robot, "hal")
configuration["listen"]["endpoints"] = [listened]
session = open_with(configuration, "the robot")
print("listens", flush=True)
while True:
    session.put(keys.sample(robot), b"1")
    time.sleep(0.02)
"""
_CLIENT = """
import os, sys, time
from services.wire import keys
from services.wire.session import open_session
robot = sys.argv[1]
arrived = []
session = open_session(robot, "client")
session.declare_subscriber(keys.sample(robot), arrived.append)
deadline = time.monotonic() + 15
while not arrived and time.monotonic() < deadline:
    time.sleep(0.05)
os._exit(0 if arrived else 3)
"""


@pytest.mark.parametrize(
    ("stopped", "seconds"),
    [*(("client", seconds) for seconds in (0.7, 1.5, 3.0)), *(("robot", seconds) for seconds in (0.7, 1.2, 3.0))],
)
def test_a_side_that_is_stopped_within_its_handshake_connects(robot: str, stopped: str, seconds: float) -> None:
    """zenoh may keep half of a connection that ends too late, and then this session is refused for ever."""
    with socket.create_server((address(robot), 0)) as free:
        listened = free.getsockname()[1]
    service = subprocess.Popen(
        [sys.executable, "-c", _ROBOT, robot, f"tcp/{address(robot)}:{listened}"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert service.stdout is not None and service.stdout.readline() == "listens\n"
        with _between(port(robot, "hal"), listened, address(robot)) as way:
            client = subprocess.Popen([sys.executable, "-c", _CLIENT, robot])
            way.seconds, way.stops = seconds, {"client": (client.pid, 0), "robot": (service.pid, 1)}[stopped]
            assert client.wait(30) == 0
            assert way.has_stopped
    finally:
        service.kill()
        service.wait()


def test_a_handshake_outlives_the_lease_of_the_other_side_and_not_the_end_of_the_program() -> None:
    local = settings("a", "client")["transport"]["unicast"]
    assert local["open_timeout"] > LEASE_MS
    assert max(local.values()) < 1e3 * CLOSE_WITHIN


_CLOSE = """
import socket, sys, time
from services.wire import session
robot = sys.argv[1]
silent = socket.create_server((session.address(robot), session.port(robot, "hal")))
session.CLOSE_WITHIN = 0.1
opened = session.open_session(robot, "client")
time.sleep(0.3)
session.close_session(opened)
print("closed")
"""


def test_a_program_that_ends_while_zenoh_still_closes_is_not_aborted(robot: str) -> None:
    """Its handshake with a port that does not answer ends with the program itself."""
    done = subprocess.run([sys.executable, "-c", _CLOSE, robot], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout, done.stderr) == (0, "closed\n", "")


class _Way:
    """Way of the bytes between a client and a service; it stops one of them before its last part of the handshake."""

    def __init__(self, sockets: list[socket.socket]) -> None:
        self.sockets = sockets
        self.stops = (0, 0)
        """Process to stop, and the direction of the part before which it stops: 1 towards the service, else 0."""
        self.seconds = 0.0
        self.has_stopped = False

    def carry(self, source: socket.socket, target: socket.socket, direction: int) -> None:
        """Carry the bytes of one direction until the end; each side sends two parts before it is connected."""
        parts = 0
        with suppress(OSError):  # either side may have closed the connection
            while data := source.recv(65536):
                parts += 1
                process, when = self.stops
                is_last_part = parts == 2 and when == direction and not self.has_stopped
                if is_last_part:
                    self.has_stopped = True
                    os.kill(process, signal.SIGSTOP)
                target.sendall(data)
                if is_last_part:
                    time.sleep(self.seconds)
                    os.kill(process, signal.SIGCONT)
        for each in (source, target):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)


@contextmanager
def _between(outer: int, inner: int, host: str) -> Iterator[_Way]:
    """Listen at the port `outer`, and carry each connection to the port `inner`."""
    server = socket.create_server((host, outer))
    way = _Way([server])

    def accept() -> None:
        with suppress(OSError):  # the server is closed at the end
            while True:
                client, _ = server.accept()
                service = socket.create_connection((host, inner))
                way.sockets += [client, service]
                for direction, (source, target) in enumerate([(service, client), (client, service)]):
                    threading.Thread(target=way.carry, args=(source, target, direction), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield way
    finally:
        for each in way.sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
