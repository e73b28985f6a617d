"""A ROS 2 network for tests: a router, and a plain zenoh session that reads topics."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zenoh

from services.process.router import routing
from services.ros2 import cdr, names
from services.ros2.bridge import run_bridge
from services.ros2.node import Network, open_session
from services.watch.frames import Frames
from services.wire.session import close_session


def eventually(happened: Callable[[], object], within: float = 20.0) -> None:
    deadline = time.monotonic() + within
    while not happened():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def ros_network(distribution: str = "jazzy") -> Iterator[Network]:
    place = f"tcp/127.0.0.1:{free_port()}"
    with routing([place]):
        yield Network(place, 0, distribution)


@contextmanager
def bridge(robot: str, network: Network, frames: Frames | None = None, rate: float = 50.0) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=run_bridge, args=(robot, network, (), frames, rate, stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(15.0)
        assert not thread.is_alive()


class Listener:
    """Keeps the messages of topics, decoded, with their attachments; and the liveliness tokens."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.session = open_session(network)
        self.tokens: set[str] = set()
        self._subscribers: list[Any] = [
            self.session.liveliness().declare_subscriber("@ros2_lv/**", self._token, history=True)
        ]

    def __enter__(self) -> "Listener":
        return self

    def __exit__(self, *_: object) -> None:
        close_session(self.session)

    def listen(self, topic: str, kind: str) -> list[tuple[dict[str, Any], tuple[int, int, bytes]]]:
        heard: list[tuple[dict[str, Any], tuple[int, int, bytes]]] = []
        hash_ = names.hash_of(kind, self.network.distribution)

        def take(sample: zenoh.Sample) -> None:
            attachment = names.read_attachment(sample.attachment.to_bytes())
            heard.append((cdr.decode(kind, sample.payload.to_bytes()), attachment))

        self._subscribers.append(self.session.declare_subscriber(names.data_key(0, topic, kind, hash_), take))
        return heard

    def _token(self, sample: zenoh.Sample) -> None:
        change = self.tokens.add if sample.kind == zenoh.SampleKind.PUT else self.tokens.discard
        change(str(sample.key_expr))
