import json
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from services.errors import NotAllowed, ServiceError
from services.security.init import CA_KEY, init, placed, planned
from services.wire.connect import expiry_warning, exposure_warning, with_password_file
from services.wire.session import address, settings


def made(folder: Path, *robots: str, days: int | None = None) -> Path:
    init(folder, planned(folder, {name: placed(address(name)) for name in robots}, [], None, days))
    return folder


def again(folder: Path, *robots: str) -> tuple[set[str], set[str]]:
    done = init(folder, planned(folder, {name: placed(address(name)) for name in robots}, [], None, None))
    return set(done.made), set(done.changed)


def test_secrets_are_for_their_owner_only(tmp_path: Path) -> None:
    folder = made(tmp_path / "keys", "a")
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    for path in [folder / CA_KEY, *folder.glob("*.json")]:
        assert stat.S_IMODE(path.stat().st_mode) == (0o644 if path.name == "plan.json" else 0o600)
        assert not exposure_warning(path) or path.name == "plan.json"


def test_a_file_that_others_may_read_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = made(tmp_path / "keys", "a") / "viewer.json"
    path.chmod(0o644)
    settings("a", "client", [str(path)])
    assert "HOLDS A PASSWORD AND A KEY, AND OTHERS MAY READ IT: chmod 600" in caplog.text


def test_a_second_time_nothing_is_made(tmp_path: Path) -> None:
    folder = made(tmp_path / "keys", "a")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert again(folder, "a") == (set(), set())
    assert before == {path.name: path.read_bytes() for path in folder.iterdir()}


def test_another_robot_changes_the_router_only(tmp_path: Path) -> None:
    folder = made(tmp_path / "keys", "a")
    made_now, changed = again(folder, "b")
    assert changed == {"router.json"} and "hal.b.json" in made_now and "viewer.json" not in made_now


def test_a_renewed_role_has_another_password_which_its_doors_know(tmp_path: Path) -> None:
    folder = made(tmp_path / "keys", "a")
    (folder / "model.a.json").unlink()
    made_now, changed = again(folder)
    assert made_now == {"model.a.json"} and changed == {"router.json", "hal.a.json", "vision.a.json"}


def test_without_the_authoritys_key_nothing_new_is_signed(tmp_path: Path) -> None:
    folder = made(tmp_path / "keys", "a")
    (folder / CA_KEY).unlink()
    assert again(folder) == (set(), set())
    (folder / "viewer.json").unlink()
    with pytest.raises(ServiceError, match="Put the key back from its offline copy"):
        again(folder)


def test_what_contradicts_the_folder_is_refused(tmp_path: Path) -> None:
    folder = made(tmp_path / "keys", "a")
    with pytest.raises(ServiceError, match="was made with protocol quic, not tls"):
        planned(folder, {}, [], "tls", None)
    with pytest.raises(ServiceError, match="To move it, edit plan"):
        planned(folder, {"a": placed("10.0.0.1")}, [], None, None)
    with pytest.raises(ServiceError, match="cannot be a name here"):
        planned(folder, {"a b": placed("10.0.0.1")}, [], None, None)
    with pytest.raises(ServiceError, match="needs at least one --robot"):
        planned(tmp_path / "new", {}, [], None, None)


def test_a_role_file_is_for_its_robot_and_service(tmp_path: Path) -> None:
    folder = made(tmp_path / "keys", "a", "b")
    with pytest.raises(NotAllowed, match="is for robot a, not for 'b'"):
        settings("b", "hal", [str(folder / "hal.a.json")])
    with pytest.raises(NotAllowed, match="is for role 'viewer'"):
        settings("a", "hal", [str(folder / "viewer.json")])
    with pytest.raises(NotAllowed, match="takes that of operator or viewer"):
        settings("a", "client", [str(folder / "hal.a.json")])


def test_an_ending_certificate_is_told(tmp_path: Path) -> None:
    soon, late = made(tmp_path / "soon", "a", days=10), made(tmp_path / "late", "a")
    assert "ends on" in expiry_warning(json.loads((soon / "viewer.json").read_text()))
    assert not expiry_warning(json.loads((late / "viewer.json").read_text()))


def test_passwords_reach_zenoh_without_a_file_on_disk(tmp_path: Path) -> None:
    found = json.loads((made(tmp_path / "keys", "a") / "router.json").read_text())
    with with_password_file(found) as taken:
        login = taken["transport"]["auth"]["usrpwd"]
        assert "dictionary" not in login and login["dictionary_file"].startswith("/proc/self/fd/")
        lines = Path(login["dictionary_file"]).read_text().splitlines()
    assert len(lines) == 6 and all(":" in line for line in lines)


def test_no_secret_in_what_others_see_of_a_process(tmp_path: Path) -> None:
    path = made(tmp_path / "keys", "a") / "router.json"
    found = json.loads(path.read_text())
    login, tls = found["transport"]["auth"]["usrpwd"], found["transport"]["link"]["tls"]
    secrets = [*login["dictionary"].values(), tls["listen_private_key_base64"]]
    command = [sys.executable, "-m", "services.cli", "-v", "router", "--connect", str(path)]
    with socket.socket(type=socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        command += ["--listen", f"quic/127.0.0.1:{probe.getsockname()[1]}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None and "Router listens on quic/" in process.stdout.readline()
        seen = [Path(f"/proc/{process.pid}/{name}").read_text() for name in ("cmdline", "environ")]
    finally:
        process.terminate()
        seen.append(process.communicate(timeout=20)[0])
    assert process.returncode == 0
    assert not [secret for secret in secrets for text in seen if secret in text]
