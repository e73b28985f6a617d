"""Usual mistakes, typed: each is one sentence that says what happened and what to do, without a traceback."""

import os
import shutil
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from services.cli import app
from services.process.lock import instead_of

ROBOTS = Path(__file__).parents[2] / "robots"
NAME = f"slips_{os.getpid()}"
GOOD = f"""\
robot: {NAME}
signals:
  joint_position: {{unit: rad, elements: [elbow, wrist]}}
command: {{signal: joint_position}}
limits:
  joint_position: {{low: -1, high: 1, rate: 1}}
buses:
  can0: {{interface: hub, channel: {NAME}_can0}}
kinds:
  drive: {{driver: cia402, settings: {{eds: eds/servo_drive.eds, counts_per_turn: 4096, gear: 50}}}}
devices:
  elbow_drive: {{kind: drive, bus: can0, node: 1, element: joint_position.elbow}}
  wrist_drive: {{kind: drive, bus: can0, node: 2, element: joint_position.wrist}}
simulator: simulators.robots.bench:simulator
"""
FILES = {
    "good.yaml": GOOD,
    "README.md": "# My robot\n\nIt has: two arms\n- and a head\n",
    "arm.urdf": "<robot name='a'><link name='a'></robot>",
    "arm.xacro": "<robot name='a' xmlns:xacro='http://www.ros.org/wiki/xacro'><xacro:x/></robot>",
    "panda.xml": "<mujoco><worldbody/></mujoco>",
    "bad.eds": "hello",
    "empty.yaml": "",
    "tab.yaml": "robot: a\nsignals:\n\tx: 1\n",
    "data.csv": "a,b\n1,2\n",
    "broken.mcap": "hello",
    "nothing/notes.txt": "no device",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return the working directory, with a good robot file and things that are none."""
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    shutil.copytree(ROBOTS / "eds", tmp_path / "eds")
    yield tmp_path
    sys.modules.pop("my_sim", None)


def refusal(*words: str) -> str:
    """Type a command; return its one sentence."""
    result = CliRunner().invoke(app, words)
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code in (1, 2)
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("gemuco: ")
    return lines[0].removeprefix("gemuco: ")


WORDS = [
    (("hal", "musashi_arms"), "There is no robot 'musashi_arms'. Did you mean 'musashi_arm'?"),
    (("hal", "arms/mine.yaml"), "There is no robot file 'arms/mine.yaml'. Is 'arms' the right folder?"),
    (("train", "walk.csv"), "There is no file 'walk.csv'. Is its folder right?"),
    (("simulate", "README.md"), "is not a robot file, whose name ends in .yaml"),
    (("demo", "arm.urdf"), "`gemuco init arm.urdf` makes one"),
    (("hal", "eds"), "`gemuco init eds` drafts one from EDS and DBC files"),
    (("hal", "empty.yaml"), "is empty or not a mapping. Compare it with robots/*.yaml."),
    (("hal", "tab.yaml"), "line 3, column 1: found character '\\t' that cannot start any token; indent with spaces"),
    (("simulat", "good.yaml"), "No such command 'simulat'. Did you mean 'simulate'? `gemuco --help` lists"),
    (("collect", "good.yaml", "--samples", "0"), "Invalid value for '--samples'"),
    (("demo", "good.yaml", "--sed", "1"), "`gemuco demo --help` lists what it takes."),
    (("export", "broken.mcap"), "Missing option '--out'. `gemuco export --help` lists what it takes."),
    (("serve", "good.yaml"), "There is no model in 'runs/"),
    (("serve", "good.yaml"), "Make one with `gemuco collect` and `gemuco train`."),
    (("train", "good.yaml"), "Record one with `gemuco collect`."),
    (("train", "good.yaml", "--data", "data.csv"), "data.csv"),
    (("train", "data.csv"), "`gemuco describe data.csv` drafts a description to train from."),
    (("collect", "good.yaml"), "has no 'collect' section, so its safe motion is unknown. docs/robots.md, Collecting"),
    (("collect", "musashi_arm", "--variant", "broken"), "has no variant 'broken'. Known variants: geometric, actual."),
    (("simulate", "kxr_humanoid", "--condition", "axe"), "has no condition 'axe'. Known conditions: short_light"),
    (("demo", "good.yaml"), "has no model.control section, so there is nothing to play. Name the signal"),
    (("query", "good.yaml", "estimat", "joint_position"), "'estimat' is not a verb of query. Known: estimate"),
    (("query", "good.yaml", "move", "joint_position", "far"), "takes numbers after the signal, not 'far'."),
    (("query", "good.yaml", "fault"), "needs a fault of the simulator"),
    (("query", "good.yaml", "holder", "--connect", "192.168.0.5:7447"), "An endpoint would begin with tcp/"),
    (("router", "--listen", "here"), "An endpoint reads tcp/192.168.0.5:7447"),
    (("replay", "none.mcap"), "The recording 'none.mcap' cannot be read: No such file"),
    (("replay", "broken.mcap"), "'broken.mcap' is not a recording"),
    (("describe", "none.csv"), "There is no file or folder 'none.csv'. Give a table"),
    (("scan",), "Name either a robot, or --interface and --channel"),
    (("scan", "--interface", "socketcan"), "needs a --channel, such as can0."),
    (("init", "arm.yaml"), "is not a URDF or MJCF file. A robot file is ready: `gemuco demo arm.yaml`."),
    (("scan", "--interface", "sockectan", "--channel", "can0"), "is not known to python-can. Known: "),
    (("calibrate", "joint", "good.yaml", "elbow"), "Devices: elbow_drive, wrist_drive."),
    (("calibrate", "cell", "good.yaml", "elbow_drive"), "Is it `gemuco calibrate joint`?"),
    (("init",), "Give a URDF or MJCF file, a folder with EDS, DCF and DBC files, --scan can0, or --ros2."),
    (("init", "nothing"), "has no EDS, DCF or DBC file. Give the folder with the files of your devices"),
    (("init", "none.urdf"), "There is no file 'none.urdf'. Is its folder right?"),
    (("init", "arm.urdf"), "is not XML: mismatched tag"),
    (("init", "arm.xacro"), "Convert it first: xacro arm.xacro > robot.urdf"),
    (("init", "--scan", "nonsense:can0"), "'nonsense' is not known to python-can"),
    (("init", "eds", "--name", "My Arm"), "Give another --name."),
    (("init", "eds", "--tip", "hand"), "--tip is for a URDF or MJCF file"),
    (("security", "check", "keys"), "was not made by `gemuco security init`"),
    (("reproduce", "talos"), "There are no experiments 'talos'. Known: pr2, musashi, kxr."),
    (("vision", "good.yaml"), "has no signal with `source: vision`, so it needs no camera."),
]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "text"), WORDS, ids=lambda value: " ".join(value) if isinstance(value, tuple) else ""
)
def test_a_wrong_command_is_answered_in_a_sentence(folder: Path, words: tuple[str, ...], text: str) -> None:
    assert text in refusal(*words)


CHANGES = [
    ("  joint_position: {low", "  joint_positions: {low", "limits.joint_positions is not a signal. Known: joint_pos"),
    ("{signal: joint_position}", "{signal: joint_positon}", "'joint_positon' is not a signal. Known: joint_position."),
    ("joint_position.elbow", "joint_position.elbo", "serves 'joint_position.elbo', which no signal has. Known elem"),
    ("unit: rad", "unit: deg", "'deg' is not an SI unit; write unit: rad, and written_in: deg"),
    ("unit: rad", "unit: Nm", "the unit 'Nm' is written 'N m'."),
    ("unit: rad", "unit: m", "joint_position"),
    ("rate: 1", "rate: fast", "limits.joint_position.rate: 'fast' is not a number."),
    ("node: 2", "node: two", "devices.wrist_drive.node: 'two' is not a whole number."),
    ("low: -1, high: 1", "low: 1, high: -1", "low must be below high"),
    ("[elbow, wrist]", "[elbow, elbow]", "element 'elbow' is there twice"),
    ("node: 2", "node: 1", "both claim node 1 on bus 'can0'."),
    ("node: 2", "node: 200", "a CANopen node id is 1 to 127."),
    ("bus: can0, node: 2", "bus: can1, node: 2", "is on bus 'can1'. Known buses: can0."),
    ("kind: drive, bus: can0, node: 2", "kind: drives, bus: can0, node: 2", "Known kinds: drive."),
    ("driver: cia402", "driver: cia403", "There is no driver 'cia403'. Known: cia402"),
    ("gear: 50", "geer: 50", "allow_no_watchdog. Did you mean 'gear'?"),
    ("limits:", "limit:", "Did you mean 'limits'?"),
    ("eds/servo_drive", "eds/servo", "The path is relative to the folder of the robot file."),
    ("eds/servo_drive.eds", "bad.eds", "is not an EDS file that canopen can read"),
    ("eds/servo_drive.eds", "eds/load_cell.eds", "has device profile 404, not 402. Is it another device's?"),
    (f"robot: {NAME}", "robot: My Arm", "'My Arm' is no name of a robot"),
    ("interface: hub", "interface: sockectan", "'sockectan' is not known to python-can."),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "text"), CHANGES, ids=lambda value: "" if " " in value else value)
def test_a_wrong_robot_file_is_refused_in_a_sentence(folder: Path, old: str, new: str, text: str) -> None:
    assert old in GOOD
    (folder / "good.yaml").write_text(GOOD.replace(old, new))
    assert text in refusal("hal", "good.yaml")


SIMULATORS = [
    ("simulator: simulators.robots.bench:simulator", "", "add `simulator: module:name` to its file"),
    ("simulators.robots.bench:simulator", "my_sim:simulator", "Is its package installed, or the module beside"),
    ("simulators.robots.bench:simulator", "my_sim", "is not of the form 'module:name', as my_sim:simulator is."),
    ("interface: hub", "interface: socketcan", "Bus 'can0' does not open: "),
    ("driver: cia402", "driver: my_drives:Drive", "The bench has no other end for device 'elbow_drive'"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "text"), SIMULATORS, ids=lambda value: "" if " " in value else value)
def test_a_wrong_simulator_is_refused_in_a_sentence(folder: Path, old: str, new: str, text: str) -> None:
    assert old in GOOD
    (folder / "good.yaml").write_text(GOOD.replace(old, new))
    assert text in refusal("simulate", "good.yaml")


def test_a_second_service_of_the_same_name_is_refused(folder: Path) -> None:
    with instead_of(NAME, "simulator"):
        sentence = refusal("simulate", "good.yaml")
    assert f"already has a 'simulator' service: process {os.getpid()} on this machine. Stop that one first." in sentence


def test_a_port_that_is_taken_is_named(folder: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"Port {port} of the router is taken by another process. See which: `ss" in refusal(
            "router", "--listen", f"tcp/127.0.0.1:{port}"
        )


@pytest.mark.parametrize(
    ("package", "extra", "words"),
    [
        ("mujoco", "sim", ("init", "panda.xml")),
        ("viser", "view", ("view", "good.yaml")),
        ("matplotlib", "train", ("demo", "musashi_arm")),
    ],
)
def test_a_missing_package_is_named_with_its_extra(
    folder: Path, monkeypatch: pytest.MonkeyPatch, package: str, extra: str, words: tuple[str, ...]
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    sentence = refusal(*words)
    assert f"'{package}'" in sentence
    assert "not installed here: pip install 'gemuco[" in sentence
    assert extra in sentence


@pytest.mark.slow
def test_a_question_to_a_robot_that_does_not_run_says_what_to_start(folder: Path) -> None:
    assert "Is `gemuco serve` running?" in refusal("query", "good.yaml", "estimate", "joint_position")
    result = CliRunner().invoke(app, ["estop", "good.yaml"])
    assert result.exit_code == 1
    assert "CUT THE POWER" in result.stderr


def test_no_mistake_left_a_file(folder: Path) -> None:
    before = sorted(folder.rglob("*"))
    for words in (("init", "arm.urdf"), ("init", "nothing"), ("train", "good.yaml"), ("replay", "none.mcap")):
        refusal(*words)
    assert sorted(folder.rglob("*")) == before
