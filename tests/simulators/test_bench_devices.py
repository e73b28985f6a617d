"""What vendors ship, on the bench: the examples of docs/devices.md, EDS and DCF files with gaps, any DBC file."""

import re
from pathlib import Path

import canopen
import numpy as np
import pytest
import yaml
from on_bench import arrives, cycle_until, running, states, virtual

from hal.errors import ConfigError
from hal.protocols.eds import is_relative, read_sheet, value_of
from hal.registry import DRIVERS
from simulators.nodes.canopen.spec import EDS_FOLDER

ROOT = Path(__file__).parents[2]
EXAMPLES = {
    block.split()[1]: block
    for block in re.findall(r"```yaml\n(robot: .*?)```", (ROOT / "docs" / "devices.md").read_text(), re.DOTALL)
}


def test_the_page_has_an_example_of_every_kind_of_device() -> None:
    drivers = {kind["driver"] for text in EXAMPLES.values() for kind in yaml.safe_load(text)["kinds"].values()}
    assert drivers == set(DRIVERS)


@pytest.mark.long
@pytest.mark.parametrize("name", EXAMPLES)
def test_every_documented_example_runs_on_the_bench(name: str) -> None:
    config = virtual(yaml.safe_load(EXAMPLES[name]) | {"folder": ROOT / "robots"})
    signal = config.command.signal
    low, high = config.bounds(signal)
    with running(config) as (robot, _):
        start = cycle_until(robot, lambda sample: sample.complete and np.isfinite(sample.values[signal]).all())
        target = np.clip(start.values[signal] + 0.02, low, high)
        cycle_until(robot, arrives(signal, target), target)
        assert set(states(robot).values()) <= {"ready", "enabled"}


def without_defaults(text: str, *objects: str, value: str = "") -> str:
    """Return an EDS file whose objects have no DefaultValue, or the ParameterValue of a DCF file."""
    for section in objects:
        head, part, rest = text.partition(f"[{section}]")
        assert part
        body, gap, others = rest.partition("\n[")
        text = head + part + re.sub(r"DefaultValue=.*\n", value, body + "\n") + gap + others
    return text


def with_lines(text: str, section: str, **lines: str) -> str:
    """Return an EDS file with other or more lines in a section."""
    head, part, rest = text.partition(f"[{section}]\n")
    assert part
    body, gap, others = rest.partition("\n[")
    kept = [line for line in body.splitlines() if line and line.partition("=")[0] not in lines]
    return head + part + "\n".join([*kept, *(f"{name}={value}" for name, value in lines.items())]) + "\n" + gap + others


DRIVE = (EDS_FOLDER / "servo_drive.eds").read_text()
UNSTATED = ("1000", "1018sub1", "1018sub2", "1018sub3", "6502")


def joint(folder: Path, sheet: str, **settings: object) -> dict:
    return {
        "robot": "joint_bench",
        "folder": folder,
        "signals": {"joint_position": {"unit": "rad", "elements": ["one"]}},
        "command": {"signal": "joint_position"},
        "limits": {"joint_position": {"low": -2.0, "high": 2.0, "rate": 1.0}},
        "buses": {"can0": {"bitrate": 1000000}},
        "kinds": {
            "drive": {"driver": "cia402", "settings": {"eds": sheet, "counts_per_turn": 4096, "gear": 50, **settings}}
        },
        "devices": {"joint": {"kind": "drive", "bus": "can0", "node": 5, "element": "joint_position.one"}},
    }


@pytest.mark.long
@pytest.mark.parametrize(
    ("section", "lines"),
    [
        ("Comments", {"Lines": "3"}),  # of which it has one
        ("1016sub1", {"HighLimit": "65535"}),  # as if it were only a time
        ("1018sub4", {"DefaultValue": "0x5555555"}),  # as a tool writes it
        ("6065", {"DefaultValue": "0"}),
    ],
)
def test_a_makers_file_with_what_makers_write_is_simulated(tmp_path: Path, section: str, lines: dict[str, str]) -> None:
    (tmp_path / "odd.eds").write_text(with_lines(DRIVE, section, **lines))
    with running(virtual(joint(tmp_path, "odd.eds"))) as (robot, _):
        cycle_until(robot, arrives("joint_position", np.array([0.05])), np.array([0.05]))
        assert states(robot) == {"joint": "enabled"}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("bare.eds", without_defaults(DRIVE, *UNSTATED)),
        ("set.dcf", without_defaults(DRIVE, "1000", value="ParameterValue=0x00020192\n")),
        ("latin.eds", without_defaults(DRIVE, *UNSTATED).replace("VendorName=", "VendorName=Größe & Söhne ")),
        (
            "empty.eds",
            DRIVE.replace("DefaultValue=993", "DefaultValue=").replace("[DeviceInfo]", "[DeviceInfo]\nOrderCode="),
        ),
    ],
)
@pytest.mark.long
def test_a_makers_file_with_gaps_is_simulated(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_bytes(text.encode("cp1252"))
    with running(virtual(joint(tmp_path, name))) as (robot, _):
        cycle_until(robot, arrives("joint_position", np.array([0.05])), np.array([0.05]))
        assert states(robot) == {"joint": "enabled"}


def test_the_identity_is_that_of_the_file_even_without_defaults(tmp_path: Path) -> None:
    text = without_defaults(DRIVE, *UNSTATED)
    (tmp_path / "bare.eds").write_text(re.sub(r"VendorNumber=.*", "VendorNumber=0xACE0", text))
    with running(virtual(joint(tmp_path, "bare.eds"))) as (robot, _):
        assert robot._devices[0].identity.startswith("canopen:0000ACE0-")


def test_the_modes_of_a_makers_drive_are_those_of_its_file(tmp_path: Path) -> None:
    (tmp_path / "old.eds").write_text(DRIVE.replace("DefaultValue=993", "DefaultValue=0x21"))
    with running(virtual(joint(tmp_path, "old.eds"))) as (robot, _):
        device = robot.health()["devices"]["joint"]
        assert "does not have the mode cyclic synchronous position" in device["text"]
    with running(virtual(joint(tmp_path, "old.eds", mode="profile_position"))) as (robot, _):
        cycle_until(robot, arrives("joint_position", np.array([0.05])), np.array([0.05]))


def test_a_dcf_has_values_that_go_before_defaults(tmp_path: Path) -> None:
    text = without_defaults(DRIVE, "1014", value="DefaultValue=$NODEID+0x80\nParameterValue=0x99\n")
    (tmp_path / "set.dcf").write_text(text)
    sheet = read_sheet(tmp_path / "set.dcf", 7)
    assert (value_of(sheet[0x1014]), is_relative(sheet[0x1014])) == (0x99, False)
    assert (value_of(sheet[0x1200][1]), is_relative(sheet[0x1200][1])) == (0x607, True)


def test_what_is_no_eds_is_refused_in_a_sentence(tmp_path: Path) -> None:
    for name, content in (
        ("a.eds", b"hello"),
        ("b.eds", b"\x00\x01\x02"),
        ("c.eds", b"[1000]\nnothing"),
        ("d.eds", b""),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ConfigError) as caught:
            running(virtual(joint(tmp_path, name))).__enter__()
        words = "its data sheet has 0 of them" if name == "c.eds" else "is not an EDS file that canopen can read"
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)


def test_canopen_reads_the_shipped_files_as_before() -> None:
    for path in EDS_FOLDER.glob("*.eds"):
        ours, theirs = read_sheet(path, 9), canopen.import_od(str(path), node_id=9)
        assert list(ours) == list(theirs)
        assert [item.default for item in ours.values() if hasattr(item, "default")] == [
            item.default for item in theirs.values() if hasattr(item, "default")
        ]
