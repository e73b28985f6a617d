"""A robot's processes with the role files of `gemuco security init`, all on this machine: who gets in, what leaks."""

import base64
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import yaml
from mcap.exceptions import EndOfFile, InvalidMagic
from mcap.stream_reader import StreamReader
from small_arm import ROOT, description, eventually

from hal.errors import CommandRefused
from services.client import Client
from services.errors import NoAnswer, NotAllowed
from services.process.supervisor import Supervisor, gemuco_command
from services.security.authority import Authority, Identity, encoded
from services.security.init import CA, CA_KEY, init, placed
from services.security.plan import InstallationPlan
from services.security.role_files import PERSON_SESSIONS
from services.verbs.ask import estop_robot
from services.wire.session import address

LEFT = timedelta(seconds=6)
"""How long the short certificate lasts: enough to get in on a busy machine."""


def free_ports(count: int) -> int:
    """The first of some consecutive free ports: the router's, that of emergency stops, and one per person."""
    while True:
        with ExitStack() as probes:
            first = 0
            try:
                for offset in range(count):
                    probe = probes.enter_context(socket.socket(type=socket.SOCK_DGRAM))
                    probe.bind(("127.0.0.1", first + offset if first else 0))
                    first = first or probe.getsockname()[1]
                return first
            except (OSError, OverflowError):
                continue


class Secured:
    """Router, simulator, HAL and recorder of a small arm, each with its role file."""

    def __init__(self, folder: Path) -> None:
        self.robot, self.keys, self.folder = f"secured_{os.getpid()}", folder / "keys", folder
        self.file, self.recording = folder / "robot.yaml", folder / "runs" / "all.mcap"
        self.file.write_text(yaml.safe_dump(description(self.robot)))
        self.router = f"127.0.0.1:{free_ports(4)}"
        init(self.keys, InstallationPlan(routers=[self.router], robots={self.robot: placed(address(self.robot))}))
        self.supervisor = Supervisor(folder / "logs")

    def start(self) -> None:
        commands = {
            "router": ("router", "--connect", self.role("router")),
            "simulator": ("simulate", str(self.file), "--connect", self.own("simulator")),
            "hal": ("hal", str(self.file), "--connect", self.own("hal")),
            "recorder": ("record", str(self.file), str(self.recording), "--connect", self.own("recorder")),
        }
        for name, command in commands.items():
            self.supervisor.start(name, gemuco_command("-v", *command))

    def role(self, name: str) -> str:
        return str(self.keys / f"{name}.json")

    def door(self, name: str) -> str:
        """The router's endpoint for a person."""
        (place,) = json.loads(Path(self.role(name)).read_text())["connect"]["endpoints"]
        return str(place)

    def own(self, service: str) -> str:
        return self.role(f"{service}.{self.robot}")

    def secrets(self) -> set[str]:
        """Every password and every private key, as it is in a role file and as it is used."""
        found = set()
        for path in self.keys.glob("*.json"):
            transport = json.loads(path.read_text()).get("transport", {})
            if transport:
                found.add(transport["auth"]["usrpwd"]["password"])
                key = transport["link"]["tls"]["connect_private_key_base64"]
                found |= {key, base64.b64decode(key).decode().splitlines()[1]}
        return found


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secured]:
    made = Secured(tmp_path_factory.mktemp("secured"))
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join((str(ROOT / "tests" / "services"), str(ROOT)))
    try:
        with made.supervisor:
            made.start()
            eventually(lambda: _hears(made), within=40.0)
            yield made
    finally:
        os.environ.pop("PYTHONPATH") if before is None else os.environ.update(PYTHONPATH=before)


def _hears(made: Secured) -> bool:
    try:
        with Client(made.robot, made.role("viewer")) as viewer:
            status = viewer.status("recorder", timeout=2.0)
            sample = viewer.sample(timeout=2.0)
            return sample is not None and sample.complete and status is not None
    except (NoAnswer, NotAllowed):
        return False


@pytest.mark.long
def test_an_operator_commands_and_a_viewer_looks_on(secured: Secured) -> None:
    with Client(secured.robot, secured.role("viewer")) as viewer:
        assert viewer.sample(timeout=5.0) is not None
        with pytest.raises(NotAllowed, match="The role 'viewer' may not ask the 'hal' service to 'enable'"):
            viewer.enable()
    with Client(secured.robot, secured.role("operator")) as operator:
        operator.enable()
        eventually(lambda: (applied := operator.applied(timeout=1.0)) is not None and applied.mode == "hold")
        operator.disable()


@pytest.mark.long
@pytest.mark.parametrize("who", ["viewer", "operator"])
def test_a_person_who_takes_all_sessions_keeps_nobody_from_stopping_the_robot(
    secured: Secured, who: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with ExitStack() as sessions:
        with suppress(NotAllowed):
            for _ in range(PERSON_SESSIONS + 1):
                sessions.enter_context(Client(secured.robot, secured.role(who)))
            raise AssertionError("it has more sessions than a person may have")
        if who == "viewer":
            with Client(secured.robot, secured.role("operator")) as operator:
                assert operator.sample(timeout=5.0) is not None
        started = time.monotonic()
        assert estop_robot(secured.robot, "tested with a full router", [secured.role("operator")]) == 0
        assert time.monotonic() - started < 3.0
    assert "drives stopped" in capsys.readouterr().out
    eventually(lambda: _resets(secured))


def _resets(secured: Secured) -> bool:
    with suppress(NotAllowed, NoAnswer), Client(secured.robot, secured.role("operator")) as operator:
        operator.reset()
        return operator.status("hal", timeout=2.0) is not None
    return False


@pytest.mark.long
def test_a_viewer_has_no_emergency_port_and_the_port_takes_nothing_else(secured: Secured, tmp_path: Path) -> None:
    found = {name: json.loads(Path(secured.role(name)).read_text()) for name in ("viewer", "operator")}
    place = found["operator"]["metadata"]["gemuco"]["emergency"]
    assert "emergency" not in found["viewer"]["metadata"]["gemuco"]
    found["viewer"]["connect"]["endpoints"] = place
    with pytest.raises(NotAllowed):
        Client(secured.robot, str(_written(tmp_path, found["viewer"]))).__enter__()
    found["operator"]["connect"]["endpoints"] = place
    with Client(secured.robot, str(_written(tmp_path, found["operator"]))) as operator:
        assert operator.sample(timeout=1.0) is None
        with pytest.raises((NoAnswer, CommandRefused)):
            operator.ask("hal", "describe", timeout=1.0)
        assert operator.stop()


@pytest.mark.long
@pytest.mark.parametrize("part", ["certificate", "password"])
def test_half_an_identity_opens_nothing(secured: Secured, tmp_path: Path, part: str) -> None:
    found, other = (json.loads(Path(secured.role(name)).read_text()) for name in ("viewer", "operator"))
    if part == "certificate":
        found["transport"]["link"]["tls"] = other["transport"]["link"]["tls"]
    else:
        found["transport"]["auth"]["usrpwd"]["password"] = "guessed"
    if part == "certificate":  # it gets in at the door of its password, and then may do what both may: nothing
        found["connect"] = other["connect"] | {"endpoints": [secured.door("viewer")]}
        path = _written(tmp_path, found)
        with Client(secured.robot, str(path)) as client:
            assert client.sample(timeout=1.0) is None
        return
    path = _written(tmp_path, found)
    with pytest.raises(NotAllowed, match=r"quic/127\.0\.0\.1:\d+ refused it"):
        Client(secured.robot, str(path)).__enter__()


@pytest.mark.long
def test_a_link_is_cut_when_its_certificate_ends(secured: Secured, tmp_path: Path) -> None:
    authority = Authority(Identity((secured.keys / CA).read_bytes(), (secured.keys / CA_KEY).read_bytes()))
    ends = datetime.now(UTC).replace(microsecond=0) + LEFT
    short = authority.sign("viewer", [], ends)
    found = json.loads(Path(secured.role("viewer")).read_text())
    found["transport"]["link"]["tls"] |= {
        "connect_certificate_base64": encoded(short.certificate),
        "connect_private_key_base64": encoded(short.key),
    }
    path = _written(tmp_path, found)
    with Client(secured.robot, str(path)) as viewer:
        assert viewer.sample(timeout=4.0) is not None
        assert datetime.now(UTC) < ends
        eventually(lambda: viewer.sample() is None, within=LEFT.total_seconds() + 10.0)
        assert datetime.now(UTC) >= ends
        time.sleep(1.0)
        assert viewer.sample() is None, "it is not let in again"
    with pytest.raises(NotAllowed, match="The certificate of the role file ended on"):
        Client(secured.robot, str(path)).__enter__()


@pytest.mark.long
def test_no_secret_in_a_log_a_recording_or_a_process_list(secured: Secured) -> None:
    secrets = secured.secrets()
    assert len(secrets) >= 20
    processes = [Path(f"/proc/{child.process.pid}") for child in secured.supervisor.children.values()]
    seen = {str(path): path.read_text() for process in processes for path in (process / "cmdline", process / "environ")}
    seen |= {path.name: path.read_text() for path in (secured.folder / "logs").iterdir()}
    eventually(lambda: sum("hal/sample" in one for one in _recorded(secured.recording)) > 0)
    seen["recording"] = "".join(_recorded(secured.recording))
    assert len(seen) == 8 + 4 + 1
    assert not [name for name, content in seen.items() if any(secret in content for secret in secrets)]


def _recorded(path: Path) -> list[str]:
    """Every record of a recording that is still written, uncompressed."""
    found = []
    with path.open("rb") as file:
        try:
            found.extend(str(record) for record in StreamReader(file).records)
        except (EndOfFile, InvalidMagic):
            return found
    return found


def _written(folder: Path, found: dict[str, object]) -> Path:
    path = folder / "role.json"
    path.touch(0o600)
    path.write_text(json.dumps(found))
    return path
