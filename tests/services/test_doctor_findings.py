"""What the doctor makes of this machine, of open ports, and of a HAL's status."""

import pwd
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hal.finding import link
from hal.finding.doctor import Severity
from services.hardware import doctor, host_checks
from services.security.init import init, placed
from services.security.plan import InstallationPlan
from services.wire.messages import Status
from services.wire.session import is_loopback

BUS = {"state": "ok", "text": "", "load": 0.41, "unknown": []}
DEVICE = {"state": "ready", "text": "", "counters": {}}
FACTS = {
    "mode": "hold",
    "fault": "",
    "buses": {"can0": BUS},
    "devices": {"elbow": DEVICE, "wrist": DEVICE},
    "cycles": 1000,
    "incomplete": 1,
    "limits": "",
}
LOOP = {"rate": 200.0, "rate_wanted": 200.0, "late_p99": 0.0002}


def report(**changes: object) -> dict[str, tuple[Severity, str]]:
    loops = {"hal": {**LOOP, **changes.pop("loop", {})}}  # type: ignore[dict-item]
    status = Status(service="hal", state="running", loops=loops, facts={**FACTS, **changes})
    return {found.what: (found.verdict, found.text) for found in doctor.from_status(status)}


def test_a_hal_that_is_well() -> None:
    found = report()
    assert {verdict for verdict, _ in found.values()} == {Severity.OK}
    assert "All 2 answer" in found["nodes"][1]


@pytest.mark.parametrize(
    ("changes", "what", "verdict", "said"),
    [
        ({"fault": "The elbow is stuck."}, "fault", Severity.BAD, "stuck"),
        ({"buses": {"can0": {**BUS, "state": "passive", "text": "Check wiring."}}}, "bus can0", Severity.BAD, "wiring"),
        ({"buses": {"can0": {**BUS, "state": "warning", "text": "Hm."}}}, "bus can0", Severity.WARNING, "Hm."),
        ({"buses": {"can0": {**BUS, "unknown": ["node 33"]}}}, "unknown nodes can0", Severity.WARNING, "node 33"),
        ({"devices": {"elbow": {**DEVICE, "state": "silent", "text": "Gone."}}}, "node elbow", Severity.BAD, "Gone."),
        ({"devices": {"elbow": {**DEVICE, "text": "Warm."}}}, "node elbow", Severity.WARNING, "Warm."),
        ({"incomplete": 100}, "cycles", Severity.WARNING, "90.0% of 1000 cycles"),
        ({"loop": {"late_p99": 0.02}}, "cycle time", Severity.WARNING, "Is this machine busy?"),
        ({"limits": "Blind."}, "limits", Severity.WARNING, "Blind."),
    ],
)
def test_a_hal_that_is_not(changes: dict[str, object], what: str, verdict: Severity, said: str) -> None:
    found = report(**changes)
    assert found[what][0] is verdict
    assert said in found[what][1]


def test_open_ports_are_seen_with_their_addresses() -> None:
    with socket.create_server(("127.0.0.1", 0)) as inside, socket.create_server(("0.0.0.0", 0)) as outside:
        ports = {number: address for protocol, address, number in doctor.listening() if protocol == "tcp"}
        assert is_loopback(ports[inside.getsockname()[1]])
        assert not is_loopback(ports[outside.getsockname()[1]])
    with socket.socket(type=socket.SOCK_DGRAM) as outside:
        outside.bind(("0.0.0.0", 0))
        assert ("udp", "0.0.0.0", outside.getsockname()[1]) in doctor.listening()


def test_every_check_of_this_machine_says_something() -> None:
    found = [*host_checks.clocks(), *host_checks.real_time()]
    names = ["wall clock", "clock steps", "clock source", "scheduling", "memory", "processor"]
    assert [finding.what for finding in found] == names
    assert all(finding.text for finding in found)


def test_other_users_who_can_command_the_robot_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def user(name: str, number: int, shell: str = "/bin/bash") -> pwd.struct_passwd:
        return pwd.struct_passwd((name, "x", number, number, "", "/", shell))

    services = [user("root", 0), user("daemon", 1, "/usr/sbin/nologin"), user("nobody", 65534, "/usr/sbin/nologin")]
    people = [user("anna", 1001), user("bert", 1002)]
    monkeypatch.setattr(host_checks.os, "geteuid", lambda: 1001)
    for known, verdict, said in (
        (services, Severity.OK, "only root and this user can log in here"),
        (services + people, Severity.WARNING, "every user and program of this machine can enable motors and command "),
        (services + people, Severity.WARNING, "the robot: bert can log in here. Run `gemuco security init`"),
    ):
        monkeypatch.setattr(host_checks.pwd, "getpwall", lambda known=known: known)
        (found,) = host_checks.other_users(has_role_file=False)
        assert (found.what, found.verdict) == ("users", verdict) and said in found.text
    (found,) = host_checks.other_users(has_role_file=True)
    assert found.verdict is Severity.OK


def test_role_files_are_checked_for_their_expiry(tmp_path: Path) -> None:
    folder, home = tmp_path / "keys", placed("127.0.0.1")
    init(folder, InstallationPlan(routers=["127.0.0.1"], robots={"a": home}, days=400))
    viewer = folder / "viewer.json"
    assert [found.verdict for found in doctor.role_files([str(viewer)])] == [Severity.OK]
    viewer.chmod(0o644)
    assert [found.verdict for found in doctor.role_files([str(viewer)])] == [Severity.OK, Severity.BAD]
    init(tmp_path / "soon", InstallationPlan(routers=["127.0.0.1"], robots={"a": home}, days=9))
    (found,) = doctor.role_files([str(tmp_path / "soon" / "viewer.json")])
    assert found.verdict is Severity.WARNING
    assert "in 8 days" in found.text
    (found,) = doctor.role_files([str(tmp_path / "none.json"), "tcp/127.0.0.1:7447"])
    assert found.verdict is Severity.BAD
    assert "cannot be read" in found.text
    assert not list(doctor.role_files(["tcp/127.0.0.1:7447"]))


def test_without_a_robot_the_machine_is_checked(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.run_doctor(None) == 0
    lines = capsys.readouterr().out.splitlines()
    for subject in ("python", "extras", "compiled code", "interface", "wall clock", "scheduling", "users"):
        assert any(line.split(maxsplit=1)[1].startswith(subject) for line in lines), subject
    assert lines[-1] == "Name a robot to check its buses and nodes too: gemuco doctor ROBOT."


def test_the_installation_names_what_is_missing_and_what_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_checks, "is_missing", lambda package: package == "viser")
    extras = {found.what: found.text for found in host_checks.installation()}["extras"]
    assert extras.startswith("matplotlib, ")
    assert extras.endswith(" Not installed: viser (view).")


@pytest.mark.parametrize(
    ("changes", "what", "verdict", "said"),
    [
        ({}, "interface can0", Severity.OK, "up, 0.5 Mbit/s"),
        ({}, "restart can0", Severity.OK, "100 ms"),
        ({"state": "BUS-OFF"}, "controller can0", Severity.BAD, "BUS-OFF"),
        ({"is_up": False}, "interface can0", Severity.WARNING, "ip link set can0 up type can bitrate 1000000"),
        ({"is_up": False, "kind": "vcan"}, "interface can0", Severity.WARNING, "`sudo ip link set can0 up`"),
        ({"kind": "vcan", "bitrate": None}, "interface can0", Severity.OK, "vcan, up."),
    ],
)
def test_the_can_interfaces_of_the_machine(
    monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], what: str, verdict: Severity, said: str
) -> None:
    sound = link.Interface("can0", True, True, "can", 500_000, 0.1, "ERROR-ACTIVE")
    monkeypatch.setattr(host_checks, "known_links", lambda: ["can0"])
    monkeypatch.setattr(host_checks, "look_up", lambda name: replace(sound, **changes))
    found = {finding.what: finding for finding in host_checks.can_interfaces()}
    assert found[what].verdict is verdict
    assert said in found[what].text
    assert len(found) == (1 if "kind" in changes or "is_up" in changes else 3 if "state" in changes else 2)
