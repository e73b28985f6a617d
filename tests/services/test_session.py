import subprocess
import sys
import time
from collections.abc import Callable

import pytest

from services import keys
from services.errors import ServiceError
from services.session import close_session, open_session, port, settings


def test_ports_are_the_robots_own_and_below_the_ephemeral_range() -> None:
    ports = {(robot, service): port(robot, service) for robot in ("a", "b", "c") for service in keys.SERVICES}
    assert len(set(ports.values())) == len(ports)
    assert all(1024 < number < 32768 for number in ports.values())


def test_each_pair_of_services_has_one_connection() -> None:
    links = [(role, settings("a", role)["connect"]["endpoints"]) for role in keys.SERVICES]
    assert [len(endpoints) for _, endpoints in links] == [0, 1, 2, 3, 4]
    assert len(settings("a", "client", ["tcp/10.0.0.1:7447"])["connect"]["endpoints"]) == 6


def test_nothing_leaves_the_machine_by_default() -> None:
    for role in (*keys.SERVICES, "client"):
        found = settings("a", role)
        endpoints = found["listen"]["endpoints"] + found["connect"]["endpoints"]
        assert all(endpoint.startswith("tcp/127.0.0.1:") for endpoint in endpoints)
        assert not found["scouting"]["multicast"]["enabled"]
        assert not found["scouting"]["gossip"]["enabled"]


def test_unknown_role_lists_the_known_ones() -> None:
    with pytest.raises(ServiceError, match="Known roles: simulator, hal, vision, model, recorder, client"):
        open_session("a", "boss")


def test_a_taken_port_is_told(robot: str) -> None:
    session = open_session(robot, "hal")
    with pytest.raises(
        ServiceError, match=f"Port {port(robot, 'hal')} of the 'hal' service of robot '{robot}' is taken"
    ):
        open_session(robot, "hal")
    close_session(session)


def _eventually(happened: Callable[[], bool], within: float = 10.0) -> bool:
    deadline = time.monotonic() + within
    while time.monotonic() < deadline:
        if happened():
            return True
        time.sleep(0.02)
    return False


_PUBLISH = """
import sys, time
from services.session import open_session
session = open_session(sys.argv[1], "hal")
while True:
    session.put(f"gemuco/{sys.argv[1]}/hal/x", b"1")
    time.sleep(0.01)
"""


def test_a_listener_that_came_first_hears_a_service_that_is_killed_and_comes_back(robot: str) -> None:
    session = open_session(robot, "client")
    heard: list[int] = []
    session.declare_subscriber(f"gemuco/{robot}/hal/x", lambda _: heard.append(1))
    for _ in range(2):
        heard.clear()
        process = subprocess.Popen([sys.executable, "-c", _PUBLISH, robot])
        try:
            assert _eventually(lambda: len(heard) > 3)
        finally:
            process.kill()
            process.wait()
    close_session(session)
