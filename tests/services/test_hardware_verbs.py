"""scan, doctor, calibrate and can dump on a small robot, whose nodes run in this very process."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
import typer
import yaml
from typer.testing import CliRunner, Result

from hal.config import RobotConfig, load_robot
from services.cli import app
from services.client import Client
from services.hardware.hal_service import run_hal
from services.process.lock import instead_of
from simulators.rig import Rig
from simulators.robots.bench import hardware
from simulators.robots.bench.world import BenchWorld

ROBOTS = Path(__file__).parents[2] / "robots"


class Stage:
    """A robot file, its nodes, and the world behind them."""

    def __init__(self, folder: Path, robot: str) -> None:
        self.path = folder / f"{robot}.yaml"
        (folder / "eds").symlink_to(ROBOTS / "eds")
        self.path.write_text(yaml.safe_dump(description(robot)))
        self.config: RobotConfig = load_robot(self.path)
        self.world = BenchWorld(self.config)
        self.rig = Rig(self.config, self.world, hardware(self.config))

    def gemuco(self, *words: str, robot: bool = True) -> Result:
        return CliRunner().invoke(app, [*words, *([str(self.path)] if robot else [])], catch_exceptions=False)

    def doctor(self, wanted: str) -> Result:
        """What the doctor says; asked again if this machine was too busy for the nodes to answer in time."""
        for _ in range(5):
            report = self.gemuco("doctor")
            if wanted in report.output:
                break
        return report

    def calibrate(self, kind: str, device: str, *words: str) -> Result:
        command = ["calibrate", kind, str(self.path), device, *words, "--seconds", "0.2"]
        return CliRunner().invoke(app, command, catch_exceptions=False)

    def set(self, element: str, value: float) -> None:
        """Have an element be something, and give the nodes time to notice."""
        self.rig.fault(f"set {element} {value}")
        steps, deadline = self._steps(), time.monotonic() + 20.0
        while self._steps() < steps + 2:
            assert time.monotonic() < deadline
            time.sleep(0.002)

    def _steps(self) -> int:
        physics = self.rig.stats()["physics"]
        assert isinstance(physics, dict)
        return int(physics["steps"])

    def stored(self, device: str) -> dict[str, float]:
        raw = yaml.safe_load((self.path.parent / f"{self.config.robot}.calibration.yaml").read_text())
        return next(record["settings"] for record in raw.values() if record["device"] == device)


def description(robot: str) -> dict[str, object]:
    drive = {
        "eds": "eds/servo_drive.eds",
        "counts_per_turn": 4096,
        "gear": 29,
        "spool_radius": 0.008,
        "watch_time": 5.0,
    }
    return {
        "robot": robot,
        "signals": {
            "joint_position": {"unit": "rad", "elements": ["elbow"]},
            "muscle_tension": {"unit": "N", "elements": ["biceps"]},
            "muscle_length": {"unit": "m", "elements": ["biceps"]},
        },
        "command": {"signal": "muscle_length"},
        "limits": {"muscle_length": {"low": 0.1, "high": 0.5, "rate": 0.25}},
        "rates": {"hal": 100},
        "buses": {"can0": {"interface": "virtual", "channel": f"{robot}_can0"}},
        "kinds": {
            "drive": {"driver": "cia402", "settings": drive},
            "cell": {"driver": "cia404", "settings": {"eds": "eds/load_cell.eds"}},
            "encoder": {"driver": "cia406", "settings": {"eds": "eds/joint_encoder.eds", "zero": -3.0}},
        },
        "devices": {
            "biceps_drive": {"kind": "drive", "bus": "can0", "node": 1, "element": "muscle_length.biceps"},
            "biceps_cell": {"kind": "cell", "bus": "can0", "node": 11, "element": "muscle_tension.biceps"},
            "elbow_encoder": {"kind": "encoder", "bus": "can0", "node": 21, "element": "joint_position.elbow"},
        },
    }


@pytest.fixture
def stage(tmp_path: Path, robot: str) -> Iterator[Stage]:
    stage = Stage(tmp_path, robot)
    stage.rig.start()
    yield stage
    stage.rig.stop()


@pytest.mark.long
def test_scan_tells_who_is_there_and_who_is_not(stage: Stage) -> None:
    report = stage.gemuco("scan", "--seconds", "0.2")
    assert report.exit_code == 0, report.output
    assert "servo drive (402)" in report.output and "biceps_drive" in report.output
    stage.rig.fault("node_silent biceps_cell")
    report = stage.gemuco("scan", "--seconds", "0.2")
    assert report.exit_code == 1
    assert "node 11 ('biceps_cell') was not found" in report.output


def test_scan_of_an_interface_needs_no_robot(stage: Stage) -> None:
    channel = stage.config.buses["can0"].channel
    for where in (("--interface", "virtual", "--channel", channel), (f"virtual:{channel}",)):
        report = stage.gemuco("scan", *where, "--seconds", "0.2", robot=False)
        assert report.exit_code == 0
        assert "encoder (406)" in report.output


def test_scan_sends_no_requests_while_the_hal_runs(stage: Stage) -> None:
    wire = can.Bus(interface="virtual", channel=stage.config.buses["can0"].channel)
    with instead_of(stage.config.robot, "hal"):
        report = stage.gemuco("scan", "--seconds", "0.2", "--mit")
    assert "The HAL of this robot runs. The scan sends no requests" in report.output
    assert wire.recv(0.0) is None
    wire.shutdown()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("scan",), "Name either a robot, or --interface and --channel"),
        (("scan", "musashi_arm", "--interface", "virtual"), "Name either a robot"),
        (("scan", "--interface", "virtual"), "--interface virtual needs a --channel"),
        (("scan", "--interface", "telepathy", "--channel", "x"), "not known to python-can. Known:"),
        (("scan", "no_such_robot"), "There is no robot 'no_such_robot'"),
        (("can", "dump", "--interface", "hub", "--channel", "nobody_serves_this"), "does not open"),
        (("can", "dump", "hub:nobody_serves_this"), "does not open"),
        (("can", "dump", "musashi_arm", "--bus", "can7"), "There is no bus 'can7'. Known: can0, can1."),
        (("calibrate", "cell", "musashi_arm", "knee"), "'knee' is neither a device nor an element of one"),
    ],
)
def test_what_is_asked_wrongly_is_one_sentence(words: tuple[str, ...], said: str) -> None:
    report = CliRunner().invoke(app, list(words), catch_exceptions=False)
    assert report.exit_code in (1, 2)
    assert said in " ".join(report.output.replace("│", " ").split())


@pytest.mark.parametrize(
    "words", [("scan",), ("doctor",), ("calibrate", "joint"), ("calibrate", "cell"), ("can", "dump")]
)
def test_every_verb_explains_itself(words: tuple[str, ...]) -> None:
    report = CliRunner().invoke(app, [*words, "--help"])
    assert report.exit_code == 0
    assert "ROBOT" in report.output


def test_help_shows_units() -> None:
    text = CliRunner().invoke(app, ["calibrate", "joint", "--help"]).output
    assert "[s]" in text and "[rad" in text


@pytest.mark.slow
def test_doctor_finds_what_is_wrong(stage: Stage) -> None:
    report = stage.doctor(", 0 bad.")
    assert report.exit_code == 0, report.output
    assert "ok       nodes                    All 3 answer." in report.output
    assert all(line.split()[0] in ("ok", "warning", "bad") for line in report.output.splitlines()[:-1])
    stage.rig.fault("node_silent elbow_encoder")
    report = stage.gemuco("doctor")
    assert report.exit_code == 1
    assert "bad      node elbow_encoder" in report.output


def test_doctor_tells_what_is_wrong_with_the_file(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("robot: wrong\ncolour: blue\n")
    report = CliRunner().invoke(app, ["doctor", str(wrong)], catch_exceptions=False)
    assert report.exit_code == 1
    assert "unknown key 'colour'" in report.output


@pytest.mark.slow
def test_doctor_asks_a_hal_that_runs(stage: Stage) -> None:
    stop = threading.Event()
    hal = threading.Thread(target=run_hal, args=(stage.config, (), stop))
    hal.start()
    try:
        with Client(stage.config.robot) as client:
            deadline = time.monotonic() + 20.0
            while (status := client.status("hal", timeout=1.0)) is None or status.state == "starting":
                assert time.monotonic() < deadline
        report = stage.gemuco("doctor")
        refused = stage.calibrate("cell", "biceps_cell", "--weight", "0", "--yes")
    finally:
        stop.set()
        hal.join()
    assert "Runs, mode 'off'. It reports its state; the buses are not opened here." in report.output
    assert "All 3 answer" in report.output
    assert refused.exit_code == 1
    assert "already has a 'hal' service" in refused.output


@pytest.mark.slow
def test_a_cell_is_calibrated_with_weights(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    loads = iter([2.0, 14.0, 26.0])
    monkeypatch.setattr(typer, "prompt", lambda *_, **__: stage.set("muscle_tension.biceps", next(loads)))
    monkeypatch.setattr(typer, "confirm", lambda *_, **__: True)
    report = stage.calibrate("cell", "biceps_cell", "--unit", "N", *(w for n in "036" for w in ("--weight", f"{n}")))
    assert report.exit_code == 0, report.output
    assert "residual" in report.output and "samples" in report.output
    assert stage.stored("biceps_cell") == pytest.approx({"zero": -0.5, "gain": 0.25}, abs=0.01)
    report = stage.calibrate("cell", "muscle_tension.biceps", "--weight", "0", "--yes")
    assert report.exit_code == 0
    assert stage.stored("biceps_cell") == pytest.approx({"zero": -6.5, "gain": 0.25}, abs=0.01)
    assert "calibration              1 devices" in stage.gemuco("doctor").output


def test_a_weight_is_given_in_kilograms(stage: Stage) -> None:
    stage.set("muscle_tension.biceps", 10.0)
    assert stage.calibrate("cell", "biceps_cell", "--weight", "2", "--yes").exit_code == 0
    assert stage.stored("biceps_cell")["zero"] == pytest.approx(9.6133)  # 2 kg are 19.6133 N


def test_a_joint_is_calibrated_at_two_positions(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    angles = iter([0.2, -0.3])
    monkeypatch.setattr(typer, "prompt", lambda *_, **__: stage.set("joint_position.elbow", next(angles)))
    monkeypatch.setattr(typer, "confirm", lambda *_, **__: True)
    report = stage.calibrate("joint", "elbow_encoder", "--at", "-0.1", "--at", "0.4")
    assert report.exit_code == 0, report.output
    assert stage.stored("elbow_encoder") == pytest.approx({"zero": 3.1, "direction": -1}, abs=1e-3)


def test_a_calibration_is_asked_for_and_may_be_dropped(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter(["much", "0.25", ""])
    monkeypatch.setattr(typer, "prompt", lambda *_, **__: next(answers))
    monkeypatch.setattr(typer, "confirm", lambda *_, **__: False)
    report = stage.calibrate("joint", "elbow_encoder")
    assert report.exit_code == 1
    assert "'much' is not a number" in report.output and "Not stored." in report.output
    assert not list(stage.path.parent.glob("*.calibration.yaml"))


@pytest.mark.long
def test_what_makes_no_calibration_is_refused(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(typer, "prompt", lambda *_, **__: "")
    same = stage.calibrate("cell", "biceps_cell", "--weight", "0", "--weight", "1", "--yes")
    assert "The cell read the same" in same.output
    unit = stage.calibrate("cell", "biceps_cell", "--weight", "0", "--unit", "stone", "--yes")
    assert "are given in kg or N" in unit.output
    nothing = stage.calibrate("joint", "elbow_encoder")
    assert "No known value was given" in nothing.output
    assert {same.exit_code, unit.exit_code, nothing.exit_code} == {1}


def test_can_dump_says_what_frames_mean(stage: Stage) -> None:
    over = threading.Event()

    def talk() -> None:
        with can.Bus(interface="virtual", channel=stage.config.buses["can0"].channel) as wire:
            while not over.wait(0.02):
                for identifier, data in ((0x000, b"\x80\x00"), (0x601, bytes.fromhex("4018100400000000"))):
                    wire.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        lines = stage.gemuco("can", "dump", "--count", "12")
        summary = stage.gemuco("can", "dump", "--seconds", "0.5", "--summary", "--node", "1")
    finally:
        over.set()
        thread.join()
    assert len(lines.output.splitlines()) == 12
    assert "enter pre-operational: all nodes" in lines.output
    assert "read 1018h:4 Identity object.Serial number" in lines.output
    assert "1 biceps_drive" in summary.output and "581" in summary.output and "NMT" not in summary.output


def test_can_dump_of_a_silent_bus_says_so(stage: Stage) -> None:
    report = stage.gemuco("can", "dump", "--seconds", "0.2")
    assert report.exit_code == 0
    assert "No frame came." in report.output
