"""The proof itself: everything is refused with what `security init` makes, and nothing with what is weakened."""

import json
from pathlib import Path
from typing import Any

import pytest

from services.errors import ServiceError
from services.security.attacks import Attempt
from services.security.check import attempts, run_check
from services.security.check_sessions import CheckSessions, Weaken
from services.security.init import init, placed, planned
from services.wire.session import address


def made(folder: Path, protocol: str, *robots: str) -> Path:
    init(folder, planned(folder, {name: placed(address(name)) for name in robots}, ["127.0.0.1"], protocol, None))
    return folder


def verdicts(found: list[Attempt], *words: str) -> set[str]:
    return {one.verdict for one in found if any(word in one.what for word in words)}


@pytest.mark.long
@pytest.mark.parametrize("protocol", ["quic", "tls"])
def test_everything_is_refused(tmp_path: Path, protocol: str, capsys: pytest.CaptureFixture[str]) -> None:
    folder = made(tmp_path / "keys", protocol, "a", "b")
    assert run_check(folder) == 0
    said = capsys.readouterr().out
    assert "NOT" not in said and said.count("refused  ") >= 54 and said.count("works  ") >= 16
    for path in folder.glob("*.json"):
        assert not [secret for secret in _passwords(path) if secret in said]


@pytest.mark.long
def test_without_any_defence_every_attack_is_told(tmp_path: Path) -> None:
    """A check that cannot fail is worthless: each of its lines fails here."""
    folder = made(tmp_path / "keys", "quic", "a", "b")
    found = list(attempts(folder, weaken=_open_the_doors(folder)))
    attacks = [one for one in found if one.verdict in ("refused", "NOT REFUSED", "not tried")]
    assert len(attacks) >= 54
    # A client still looks at its router's certificate; passwords are tried below.
    kept = [one.what for one in attacks if one.verdict != "NOT REFUSED"]
    assert kept == [
        "wrong password at the router", "no password at the router", "a router of a foreign authority",
        "wrong password at the HAL", "no password at the HAL",
    ]  # fmt: skip


@pytest.mark.long
def test_the_password_is_what_counts(tmp_path: Path) -> None:
    folder = made(tmp_path / "keys", "quic", "a")

    def other_password(name: str, found: dict[str, Any]) -> None:
        if "viewer" in found["transport"]["auth"]["usrpwd"].get("dictionary", ()):
            found["transport"]["auth"]["usrpwd"]["dictionary"]["viewer"] = "wrong"

    def no_passwords(name: str, found: dict[str, Any]) -> None:
        found["transport"].pop("auth")

    with CheckSessions(folder, weaken=other_password) as stage:
        viewer = stage.outside("viewer")
        assert not stage.enters(viewer)
        viewer["transport"]["auth"]["usrpwd"]["password"] = "wrong"
        assert stage.enters(viewer)
    with CheckSessions(folder, weaken=no_passwords) as stage:
        viewer = stage.outside("viewer")
        del viewer["transport"]["auth"]
        assert stage.enters(viewer)


@pytest.mark.long
def test_each_defence_by_itself_is_proved(tmp_path: Path) -> None:
    """Without access control at the HAL, and without certificates at the router: those lines fail, and no others."""
    folder = made(tmp_path / "keys", "quic", "a")

    def weaken(name: str, found: dict[str, Any]) -> None:
        if name in ("model", "person"):
            return
        if name == "hal":
            found["access_control"]["default_permission"] = "allow"
        else:
            found["transport"]["link"]["tls"]["enable_mtls"] = False
            for one in found["access_control"]["subjects"]:
                if "usernames" in one:  # a subject without anything is everybody
                    del one["cert_common_names"]
                elif name == "router":  # its doors show no certificate now
                    one["usernames"] = one.pop("cert_common_names")

    found = list(attempts(folder, weaken=weaken))
    assert verdicts(found, "recorder commands at the HAL") == {"NOT REFUSED"}
    assert verdicts(found, "no certificate at the router", "foreign authority at the router") == {"NOT REFUSED"}
    assert verdicts(found, "no certificate at the HAL", "wrong password", "unknown user") == {"refused"}
    assert verdicts(found, "viewer commands", "viewer spies", "viewer forges", "bytes", "floods") <= {
        "refused", "works", "not tried",
    }  # fmt: skip


def test_a_folder_without_a_plan_is_told(tmp_path: Path) -> None:
    with pytest.raises(ServiceError, match="was not made by `gemuco security init`"):
        run_check(tmp_path)


def test_nobody_at_the_running_router_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.security.check_sessions.WITHIN", 0.2)
    with pytest.raises(ServiceError, match=r"is refused at quic/127\.0\.0\.1:12 with its own role file"):
        run_check(made(tmp_path / "keys", "quic", "a"), "quic/127.0.0.1:9")


def _open_the_doors(folder: Path) -> Weaken:
    passwords = {name: _passwords(folder / f"{name}.json")[0] for name in ("viewer", "operator", "model.a")}

    def weaken(name: str, found: dict[str, Any]) -> None:
        if name == "model":
            del found["transport"]["link"]["tls"]["root_ca_certificate_base64"]
            return
        found["access_control"] = {"enabled": False}
        if name == "person":
            return
        found["transport"]["unicast"]["max_sessions"] = 1000
        found["adminspace"] = {"enabled": True}
        strangers = passwords["model.a" if name == "hal" else "viewer"]
        found["transport"]["auth"]["usrpwd"]["dictionary"] |= passwords | {"stranger": strangers}
        found["transport"]["link"]["tls"]["enable_mtls"] = False
        found["transport"]["link"]["protocols"] = ["quic", "tcp"]
        for one in list(found["listen"]["endpoints"]):
            found["listen"]["endpoints"].append(one.replace("quic/", "tcp/"))
        for limit in ("downsampling", "low_pass_filter"):
            found.pop(limit, None)

    return weaken


def _passwords(path: Path) -> list[str]:
    login = json.loads(path.read_text()).get("transport", {}).get("auth", {}).get("usrpwd", {})
    return [login[name] for name in ("password",) if name in login]
