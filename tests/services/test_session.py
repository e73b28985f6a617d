import ipaddress
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from services.errors import ServiceError
from services.wire import keys
from services.wire.session import (
    LEASE_MS,
    address,
    close_session,
    endpoint,
    is_loopback,
    open_session,
    port,
    settings,
    unsecured_endpoints,
)


def test_ports_are_the_robots_own_and_below_the_ephemeral_range() -> None:
    ports = {(robot, service): port(robot, service) for robot in ("a", "b", "c") for service in keys.SERVICES}
    assert len(set(ports.values())) == len(ports)
    assert all(1024 < number < 32768 for number in ports.values())


def test_robots_whose_ports_are_the_same_by_chance_live_beside_each_other() -> None:
    by_port: dict[int, str] = {}
    names = (f"robot_{number}" for number in range(1000))
    one, other = next(
        (before, name) for name in names if (before := by_port.setdefault(port(name, "hal"), name)) != name
    )
    assert address(one) != address(other)
    sessions = [open_session(name, "hal") for name in (one, other)]
    for session in sessions:
        close_session(session)


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        *((host, True) for host in ("127.0.0.1", "127.3.2.1", "::1", "[::1]", "::ffff:127.0.0.1", "localhost")),
        *((host, False) for host in ("0.0.0.0", "::", "192.168.0.5", "127.example.org", "robot", "")),
    ],
)
def test_loopback_is_known_by_its_number(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


def test_a_thousand_robots_have_endpoints_of_their_own_on_loopback() -> None:
    names = [f"arm_{number}" for number in range(1000)]
    assert len({endpoint(name, "hal") for name in names}) == len(names)
    assert all(ipaddress.ip_address(address(name)).is_loopback for name in names)
    assert address("arm_1") != "127.0.0.1"


def test_each_pair_of_services_has_one_connection() -> None:
    links = [(role, settings("a", role)["connect"]["endpoints"]) for role in keys.SERVICES]
    assert [len(endpoints) for _, endpoints in links] == [0, 1, 2, 3, 4]
    assert len(settings("a", "client")["connect"]["endpoints"]) == 5


def test_a_client_of_a_robot_elsewhere_has_one_link() -> None:
    found = settings("a", "client", ["tcp/10.0.0.1:7447"])
    assert found["mode"] == "client" and found["connect"]["endpoints"] == ["tcp/10.0.0.1:7447"]
    assert len(settings("a", "model", ["tcp/10.0.0.1:7447"])["connect"]["endpoints"]) == 4


def test_a_role_file_is_laid_over_the_settings(tmp_path: Path) -> None:
    file = tmp_path / "viewer.json"
    file.write_text(
        '{"connect": {"endpoints": ["quic/10.0.0.1:7447"]}, "transport": {"link": {"tls": {"enable_mtls": true}}}}'
    )
    found = settings("a", "client", [str(file)])
    assert found["mode"] == "client" and found["connect"]["endpoints"] == ["quic/10.0.0.1:7447"]
    assert found["transport"]["link"]["tls"] == {"enable_mtls": True}
    assert found["transport"]["link"]["tx"] == {"lease": LEASE_MS}


@pytest.mark.parametrize(("text", "says"), [(None, "cannot be read"), ("{", "is not JSON"), ("[]", "holds list")])
def test_a_bad_role_file_is_told(tmp_path: Path, text: str | None, says: str) -> None:
    file = tmp_path / "viewer.json"
    if text is not None:
        file.write_text(text)
    with pytest.raises(ServiceError, match=says):
        settings("a", "client", [str(file)])


@pytest.mark.parametrize(
    ("listen", "mutual", "is_open"),
    [("tcp/0.0.0.0:7447", False, True), ("tcp/127.0.0.1:7447", False, False), ("quic/0.0.0.0:7447", True, False),
     ("tcp/127.example.org:7447", False, True), ("quic/0.0.0.0:7447", False, True),
     ("tcp/[::1]:7447", False, False), ("tcp/0.0.0.0:7447", True, True)],
)  # fmt: skip
def test_what_listens_elsewhere_without_security_is_known(listen: str, mutual: bool, is_open: bool) -> None:
    link = {"link": {"tls": {"enable_mtls": mutual}}}
    assert bool(unsecured_endpoints({"listen": {"endpoints": [listen]}, "transport": link})) is is_open


def test_nothing_leaves_the_machine_by_default() -> None:
    for role in (*keys.SERVICES, "client"):
        found = settings("a", role)
        endpoints = found["listen"]["endpoints"] + found["connect"]["endpoints"]
        assert all(endpoint.startswith("tcp/127.") for endpoint in endpoints)
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
from services.wire.session import open_session
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
