"""What the files of a deployment promise, without Docker: `make test-compose` looks whether they keep it."""

import configparser
import importlib.util
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from services.hardware.hal_service import AT_REST_WITHIN
from services.verbs.verb import report_errors
from services.wire import keys

ROOT = Path(__file__).parents[2]
UNITS = sorted((ROOT / "deploy" / "systemd").glob("*.service"))
HEAVY = ("torch", "matplotlib", "pybullet", "pyarrow", "viser")
"""What the image of a robot's services does not hold."""
SERVICES = ("router", "hal", "gemuco", "recorder", "simulator", "train")
ROLES = {"hal": "hal", "gemuco": "model", "recorder": "recorder", "simulator": "simulator"}


def script(name: str) -> ModuleType:
    """A program of deploy/, which is no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "deploy" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


wanted, sbom = script("requirements"), script("sbom")


def compose(name: str = "docker-compose.yml") -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((ROOT / name).read_text())
    return found


def test_the_stack_is_what_it_is_said_to_be() -> None:
    services = compose()["services"]
    assert set(services) == set(SERVICES)
    assert {name for name, one in services.items() if one.get("profiles")} == {"simulator", "train"}
    assert all(one["profiles"] == ["simulated"] for one in services.values() if one.get("profiles"))


@pytest.mark.parametrize("name", SERVICES)
def test_every_container_can_do_little(name: str) -> None:
    one = compose()["services"][name]
    assert one["read_only"] is True
    assert one["cap_drop"] == ["ALL"]
    assert one["security_opt"] == ["no-new-privileges:true"]
    assert not {"privileged", "cap_add", "devices", "ports"} & set(one)
    assert one["pids_limit"] <= 512
    assert one["mem_limit"]
    assert one["logging"]["options"]["max-size"]
    assert all(volume.endswith(":ro") for volume in one["volumes"] if volume.startswith("."))


def test_every_container_has_a_user_and_a_runtime_folder_of_its_own() -> None:
    services = compose()["services"]
    users = {name: one["user"].split(":") for name, one in services.items()}
    assert len({user for user, _ in users.values()}) == len(services)
    assert {group for _, group in users.values()} == {"10001"}
    for name, one in services.items():
        folders = [text for text in one["tmpfs"] if text.startswith("/run/gemuco:")]
        assert len(folders) == (name != "train"), "its healthcheck is disabled"
        assert all(f"mode=0700,uid={users[name][0]}," in text for text in folders)
        assert not any("/run/gemuco" in volume for volume in one["volumes"])
    shared = {name for name, one in services.items() if any(v.startswith("buses:") for v in one["volumes"])}
    assert shared == {"hal", "simulator"}
    options = compose()["volumes"]["buses"]["driver_opts"]["o"]
    assert f"mode=0750,uid={users['simulator'][0]},gid=10001" in options
    image = (ROOT / "Dockerfile").read_text()
    assert "number=10001" in image and image.count("10001") >= len(services) - 1


PINS = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(), re.M))
LOCKED = re.findall(
    r"^# (\S+) <- (.*)\n(\S+)==(\S+) --hash=sha256:([0-9a-f]{64})$", (ROOT / "requirements.lock").read_text(), re.M
)


def test_the_lock_has_a_hash_for_every_version_that_is_pinned() -> None:
    pins = {wanted.name_of(name): version for name, version in PINS.items()}
    locked = {name: version for name, _, _, version, _ in LOCKED}
    text = (ROOT / "requirements.lock").read_text()
    assert len(LOCKED) == text.count("\n# ") - 1 == text.count("--hash"), "a line that is no entry"
    assert set(pins) - set(locked) <= {"torch"} | _not_needed(pins, locked)
    assert {name: locked[name] for name in set(pins) & set(locked)} == {
        name: pins[name] for name in set(pins) & set(locked)
    }
    assert set(locked) <= set(pins)


@pytest.mark.long
def test_every_pinned_package_runs_on_the_oldest_python_that_is_promised() -> None:
    oldest = "3.11.2"  # Debian 12's; the tests may run on a newer one, on which pip would take anything
    installed = [metadata.distribution(name) for name in PINS if _installed(name)]
    assert len(installed) > 60
    too_new = [one.name for one in installed if oldest not in SpecifierSet(one.metadata["Requires-Python"] or "")]
    assert not too_new


def _not_needed(pins: dict[str, str], locked: dict[str, str]) -> set[str]:
    """Packages that are pinned for other processors or other versions of Python only."""
    return {name for name in pins if name not in locked and not _installed(name)}


def _installed(name: str) -> bool:
    try:
        metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return False
    return True


@pytest.mark.parametrize(
    "words",
    [(), ("=matplotlib", "=pybullet", "=joblib", "+train", "+sim", "+studies"), ("+dev", "+build"),
     ("+build", "=setuptools")],
    ids=" ".join,
)  # fmt: skip
def test_what_is_installed_by_hash_needs_nothing_else(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    wanted.main(["--locked", *words])
    lines = capsys.readouterr().out.splitlines()
    chosen = {line.partition("==")[0] for line in lines}
    assert all("--hash=sha256:" in line for line in lines) and len(chosen) == len(lines)
    for name in chosen:
        for line in metadata.requires(name) or ():
            needed = Requirement(line)
            if needed.marker is None or needed.marker.evaluate({"extra": ""}):
                other = wanted.name_of(needed.name)
                assert other in chosen | {"torch"} or f"-{other}" in words or _is_in_small_image(other, words), (
                    f"{name} needs {other}"
                )


def _is_in_small_image(name: str, words: tuple[str, ...]) -> bool:
    """The workshop's image lies on the small one."""
    return "=matplotlib" in words and name in {wanted.name_of(line) for line in wanted.PROJECT["dependencies"]}


def test_no_second_index_can_slip_in_a_package() -> None:
    for path in (ROOT / "Makefile", ROOT / "Dockerfile", *(ROOT / "deploy").glob("*.*")):
        assert "extra-index" not in path.read_text().lower().replace("_", "-"), path.name


def test_the_bill_of_materials_names_what_is_installed(tmp_path: Path) -> None:
    site = metadata.distribution("numpy").locate_file("")
    status = "Package: libc6\nStatus: install ok installed\nArchitecture: amd64\nVersion: 2.36-9+deb12u10\n\n"
    status += "Package: gone\nStatus: deinstall ok config-files\nArchitecture: all\nVersion: 1\n"
    made = sbom.bill([str(site)], status)
    assert (made["bomFormat"], made["specVersion"]) == ("CycloneDX", "1.5")
    found = {one["name"]: one for one in made["components"]}
    assert found["numpy"]["purl"] == f"pkg:pypi/numpy@{metadata.version('numpy')}"
    assert re.fullmatch("[0-9a-f]{64}", found["numpy"]["hashes"][0]["content"])
    assert found["libc6"]["purl"] == "pkg:deb/debian/libc6@2.36-9%2Bdeb12u10?arch=amd64" and "gone" not in found
    assert {"cpython", "eclipse-zenoh", "pyyaml"} <= set(found)
    text = (ROOT / "Dockerfile").read_text()
    assert text.count("deploy/sbom.py /opt/") == 2


@pytest.mark.parametrize("name", [name for name in SERVICES if name != "train"])
def test_every_service_is_checked_by_its_heartbeat_and_started_again(name: str) -> None:
    one = compose()["services"][name]
    test = one["healthcheck"]["test"]
    assert test[:4] == ["CMD", "python", "-m", "services.health"]
    assert test[4] == ROLES.get(name, name)
    assert test[4] in (*keys.SERVICES, "router")
    assert one["restart"] == "unless-stopped"


def test_a_robot_is_given_the_time_to_come_to_rest() -> None:
    assert int(compose()["services"]["hal"]["stop_grace_period"].rstrip("s")) > AT_REST_WITHIN
    unit = next(unit for unit in UNITS if "hal" in unit.name)
    assert int(re.findall(r"^TimeoutStopSec=(\d+)$", unit.read_text(), re.M)[0]) > AT_REST_WITHIN


def test_secrets_are_files_of_the_host_and_each_service_sees_its_own() -> None:
    secure = compose("docker-compose.secure.yml")
    for name, one in secure["services"].items():
        (given,) = one["secrets"]
        assert given == {"source": ROLES.get(name, name), "target": "role"}
        assert "/run/secrets/role" in str(one.get("environment", one.get("command")))
    assert all(set(one) == {"file"} for one in secure["secrets"].values())
    for name in ("docker-compose.yml", "docker-compose.secure.yml", "docker-compose.realtime.yml", ".env.example"):
        assert not re.search(r"password|BEGIN [A-Z ]*KEY|token", (ROOT / name).read_text().replace("a password", ""))


def test_only_the_override_gives_capabilities() -> None:
    for name, one in compose("docker-compose.realtime.yml")["services"].items():
        assert set(one["cap_add"]) <= {"SYS_NICE", "IPC_LOCK"}
        assert set(one) <= {"cap_add", "ulimits"}, f"{name}: what is the owner's choice is a comment"


def stages() -> dict[str, list[str]]:
    """Stage -> its instructions."""
    text = re.sub(r"\\\n", " ", (ROOT / "Dockerfile").read_text())
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        if start := re.match(r"FROM \S+ AS (\w+)", line):
            found[start[1]] = []
        elif found and line.strip() and not line.startswith("#"):
            found[list(found)[-1]].append(line)
    return found


@pytest.mark.parametrize("stage", ["services", "workshop"])
def test_no_image_ends_as_root_or_installs_by_itself(stage: str) -> None:
    lines = stages()[stage]
    assert [line for line in lines if line.startswith("USER")][-1] == "USER 10001:10001"
    assert not any("apt" in line or "pip " in line for line in lines)


def test_the_image_holds_what_is_named_and_no_secrets() -> None:
    ignored = (ROOT / ".dockerignore").read_text().split()
    assert "*" in ignored
    assert "**/*.calibration.yaml*" in ignored
    named = {line[1:] for line in ignored if line.startswith("!")}
    copied = {
        word.rstrip("/")
        for lines in stages().values()
        for line in lines
        if line.startswith("COPY") and "--from" not in line
        for word in line.split()[1:-1]
    }
    assert copied <= named
    assert all((ROOT / name).exists() for name in named)


@pytest.mark.long
def test_a_robots_services_need_nothing_of_what_its_image_lacks() -> None:
    """What the small image's processes import, with the large packages out of reach."""
    modules = (
        "hardware.hal_service", "model.serve", "recording.recorder", "process.router", "verbs.deployment",
        "verbs.recording", "verbs.ask", "health",
    )  # fmt: skip
    code = "\n".join(
        [
            "import sys",
            *(f"sys.modules[{name!r}] = None" for name in HEAVY),
            "import services.cli",
            *(f"import services.{name}" for name in modules),
        ]
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr


def test_what_the_small_image_lacks_is_told_in_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(typer.Exit) as ended:
        report_errors(lambda: __import__("matplotlib"))()
    assert ended.value.exit_code == 1
    assert "needs the package 'matplotlib', not installed here: pip install 'gemuco[train]'." in capsys.readouterr().err
    with pytest.raises(ModuleNotFoundError):
        report_errors(lambda: __import__("services.no_such_file"))()


def requirements(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "deploy/requirements.py", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)


def test_requirements_of_an_image() -> None:
    small = requirements().stdout
    assert "numpy" in small
    assert not any(name in small for name in HEAVY)
    assert "numpy" not in requirements("-numpy").stdout
    assert requirements("+train", "=matplotlib", "+sim", "=pybullet").stdout.splitlines() == [
        "matplotlib>=3.9",
        "pybullet>=3.2.7; python_version < '3.12'",
    ]
    assert "does not ask for tensorflow" in requirements("-tensorflow").stderr


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_units_are_hardened_and_tell_the_manager_that_they_live(unit: Path) -> None:
    found = configparser.ConfigParser(strict=False, interpolation=None)
    found.optionxform = str  # type: ignore[assignment,method-assign]
    found.read(unit)
    service = found["Service"]
    assert service["Type"] == "notify"
    assert service["User"] == "gemuco"
    assert service["Restart"] == "always"
    assert int(service["TimeoutStopSec"]) >= 10
    for name in ("NoNewPrivileges", "ProtectHome", "PrivateTmp", "RestrictSUIDSGID", "LockPersonality"):
        assert service[name] == "yes"
    assert service["ProtectSystem"] == "strict"
    assert service["CapabilityBoundingSet"] == ""
    if unit.stem.startswith(("gemuco-hal", "gemuco-model")):
        assert int(service["LimitRTPRIO"]) > 51
        assert int(service["WatchdogSec"]) > 10


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
def test_systemd_finds_nothing_wrong_with_the_units() -> None:
    command = ["systemd-analyze", "verify", "--man=no", *map(str, UNITS)]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    said = [line for line in found.stderr.splitlines() if "/opt/gemuco/bin/gemuco is not executable" not in line]
    assert said == []
