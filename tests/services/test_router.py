"""`gemuco router` as a process: a client of it sees a robot whose services are linked with each other elsewhere."""

import itertools
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from services.client import Client
from services.errors import ServiceError, ServiceUnavailable
from services.process.router import LISTEN, router_settings, run_router
from services.wire import keys
from services.wire.messages import Estimates, Sample
from services.wire.probe import is_listening
from services.wire.query import serve_verb
from services.wire.session import close_session, open_session
from services.wire.streams import Publisher

_COUNT = itertools.count()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def eventually(happened: Callable[[], object], within: float = 10.0) -> bool:
    deadline = time.monotonic() + within
    while time.monotonic() < deadline:
        if happened():
            return True
        time.sleep(0.01)
    return False


def start_router(*words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "services.cli", "router", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    if not process.stdout.readline():
        raise AssertionError(process.communicate()[1])
    return process


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A router that is killed at the end."""
    where = f"tcp/127.0.0.1:{free_port()}"
    process = start_router("--listen", where)
    yield where
    process.kill()
    process.communicate()


class LightRobot:
    """A HAL and a model that publish as fast as they are told to, both connected to a router."""

    def __init__(self, robot: str, router: str) -> None:
        self.sessions = [open_session(robot, service, [router]) for service in ("hal", "model")]
        hal, model = self.sessions
        self.tokens = [
            session.liveliness().declare_token(keys.alive(robot, name))
            for session, name in zip(self.sessions, ("hal", "model"), strict=True)
        ]
        self.samples = Publisher(hal, keys.sample(robot), Sample, 7)
        self.estimates = Publisher(model, keys.estimate(robot), Estimates, 8)
        serve_verb(hal, keys.verb(robot, "hal", "describe"), lambda _: {"service": "hal"})
        serve_verb(model, keys.verb(robot, "model", "describe"), lambda _: {"service": "model"})

    def publish(self) -> None:
        number = next(_COUNT)
        values = {"joint_position": np.zeros(5)}
        flags = {"joint_position": np.zeros(5, bool)}
        common = {"stamp_ns": time.time_ns(), "cycle": number, "values": values}
        self.samples.put(Sample(source="can", complete=True, age=values, valid=flags, **common))
        self.estimates.put(
            Estimates(
                estimated=flags, std=values, method={"joint_position": "measured"}, mask={"joint_position": ""},
                residual={"joint_position": 0.0}, **common,
            )
        )  # fmt: skip

    def close(self) -> None:
        for session in self.sessions:
            close_session(session)


@pytest.fixture
def light(robot: str, endpoint: str) -> Iterator[LightRobot]:
    made = LightRobot(robot, endpoint)
    yield made
    made.close()


def hears(light: LightRobot, client: Client) -> bool:
    light.publish()
    return client.sample() is not None and client.estimate() is not None


def test_a_client_of_the_router_sees_and_asks_the_robot(robot: str, endpoint: str, light: LightRobot) -> None:
    with Client(robot, endpoint) as client:
        assert eventually(lambda: hears(light, client))
        assert eventually(lambda: client.alive() == {"hal", "model"})
        assert client.describe("hal") == {"service": "hal"} and client.describe("model") == {"service": "model"}
        light.tokens[1].undeclare()
        assert eventually(lambda: client.alive() == {"hal"})


def test_a_client_comes_back_when_the_router_does(robot: str) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    process = start_router("--listen", where)
    other = LightRobot(robot, where)
    try:
        with Client(robot, where) as client:
            assert eventually(lambda: hears(other, client))
            process.kill()
            process.communicate()
            assert eventually(lambda: not client.alive())
            process = start_router("--listen", where)
            back = time.monotonic()
            assert eventually(lambda: other.publish() is None and client.next_sample(0.01) is not None)
            assert client.describe("model") == {"service": "model"}
            assert time.monotonic() - back < 2.0  # seen: 0.2 to 0.6 s
    finally:
        other.close()
        process.kill()
        process.communicate()


def test_routers_of_a_fleet_are_connected(robot: str, endpoint: str, light: LightRobot) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    process = start_router("--listen", where, "--connect", endpoint)
    try:
        with Client(robot, where) as client:
            assert eventually(lambda: hears(light, client))
            assert client.describe("hal") == {"service": "hal"}
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_router_ends_when_told(number: signal.Signals) -> None:
    process = start_router("--listen", f"tcp/127.0.0.1:{free_port()}")
    process.send_signal(number)
    assert process.communicate(timeout=10) == ("", "") and process.returncode == 0


def test_a_probe_in_progress_ends_before_the_ports_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, stop, reports = threading.Event(), threading.Event(), []

    def probe(endpoints: list[str]) -> None:
        begun.set()
        time.sleep(0.2)
        reports.append(is_listening(endpoints[0]))

    monkeypatch.setattr("services.process.router.check_answers", probe)
    router = threading.Thread(target=run_router, args=([f"tcp/127.0.0.1:{free_port()}"], (), stop))
    router.start()
    assert begun.wait(10.0)
    stop.set()
    router.join(10.0)
    assert reports == [True]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--listen", "{taken}"), "of the router is taken by another process"),
        (("--listen", "tcp/nonsense"), "The endpoint 'tcp/nonsense' has no host and port"),
        (("--listen", "carrier-pigeon/loft:1"), "'carrier-pigeon/loft:1' is not an endpoint"),
        (("--connect", "tcp/nonsense"), "The endpoint 'tcp/nonsense' has no host and port"),
        (("--connect", "no_such_role.json"), "The role file 'no_such_role.json' cannot be read"),
        (("--listen", "tcp/192.0.2.1:7447"), "Cannot assign requested address"),
    ],
)
@pytest.mark.long
def test_a_router_that_cannot_start_says_why(endpoint: str, words: tuple[str, str], says: str) -> None:
    option, value = words
    listen, connect = ([value.format(taken=endpoint)], []) if option == "--listen" else ([], [value])
    with pytest.raises(ServiceError, match=re.escape(says)):
        run_router(listen, connect, threading.Event())


def test_a_router_on_a_taken_port_ends_with_a_sentence(endpoint: str) -> None:
    command = [sys.executable, "-m", "services.cli", "router", "--listen", endpoint]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    assert done.returncode == 1 and "is taken by another process" in done.stderr and "Traceback" not in done.stderr


def test_a_router_that_listens_to_all_is_loud() -> None:
    process = start_router("--listen", f"tcp/0.0.0.0:{free_port()}")
    process.terminate()
    assert "WITHOUT SECURITY: see `gemuco security init`" in process.communicate()[1]


def test_a_router_listens_on_this_machine_only_unless_told() -> None:
    assert router_settings()["listen"]["endpoints"] == list(LISTEN) == ["tcp/127.0.0.1:7447"]


@pytest.mark.slow
def test_a_client_without_a_router_is_told(robot: str) -> None:
    where = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(ServiceUnavailable, match=r"Is `gemuco router` running\?"), Client(robot, where):
        pass


def test_a_client_of_a_malformed_endpoint_is_told(robot: str) -> None:
    with pytest.raises(ServiceError, match="has no host and port"), Client(robot, f"tcp/{os.getpid()}"):
        pass
