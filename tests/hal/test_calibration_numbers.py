"""Fits of calibrations at their bounds, and the file of calibrations, by arithmetic done by hand."""

import math
from datetime import datetime

import pytest
import yaml
from hal_bench import ROBOTS, description

from hal.calibration import store
from hal.calibration.line import CalibrationRefused, Linear, Point, cell_line, joint_line, rotary, spool
from hal.calibration.store import Record
from hal.config import RobotConfig
from hal.errors import ConfigError


def point(known, read, std=0.001):
    return Point(known=known, read=read, std=std, samples=100)


@pytest.mark.parametrize(
    ("direction", "gear", "step"), [(1, 1.0, 1.0), (-1, 1.0, -1.0), (1, 4.0, 0.25), (-1, 0.5, -2.0)]
)
def test_counts_of_a_joint_and_a_wire(direction, gear, step):
    """1000 counts per motor turn: a count is 2 pi / 1000 rad before the gear, or 0.02 m times that on a spool."""
    count = step * 2 * math.pi / 1000
    assert rotary(1000, gear, direction, 0.5) == Linear(0.5, pytest.approx(count))
    assert spool(1000, gear, direction, 0.5, 0.02) == Linear(0.5, pytest.approx(0.02 * count))


def test_the_nearest_count():
    line = Linear(0.5, -0.1)
    assert line.to_si(3) == pytest.approx(0.2)
    assert [line.to_counts(value) for value in (0.5, 0.36, 0.34, 0.66)] == [0, 1, 2, -2]


@pytest.mark.parametrize(
    ("moved", "read", "text"),
    [
        (0.1, 0.1, None),
        (0.0999, 0.0999, "move by at least 0.1"),
        (-0.1, 0.1, None),
        (1.0, 0.0201, "wrong by a factor of 0.0201"),
        (1.0, 0.0199, "read the same at positions that differ by 1. "),
        (1.0, 0.92, None),
        (1.0, 0.90, "wrong by a factor of 0.9"),
        (0.91, 1.0, None),
        (0.89, 1.0, r"moved by 0.89, the device read 1: .* wrong by a factor of 1.12"),
    ],
)
def test_the_motion_of_a_joint(moved, read, text):
    """At least 0.1 rad, of which the device must read a fifth; and within a tenth of the known motion."""
    points = [point(0.0, 0.0), point(moved, read)]
    if text is None:
        line = joint_line(points, -1, 0.1)
        assert line.factor == math.copysign(1.0, moved)
        assert line.zero == pytest.approx((moved - line.factor * read) / 2)
        assert line.residual == pytest.approx(abs(moved - line.factor * read) / 2)
    else:
        with pytest.raises(CalibrationRefused, match=text):
            joint_line(points, -1, 0.1)


def test_one_position_of_a_joint():
    line = joint_line([point(0.5, 2.0)], 1, 0.1)
    assert (line.zero, line.factor, line.residual) == (-1.5, 1, 0.0)


@pytest.mark.parametrize(
    ("weight", "read", "std", "text"),
    [
        (1.0, 1.0, 0.001, None),
        (0.999, 1.0, 0.001, "which is not ten times the noise of 0.1 N"),
        (10.0, 0.61, 0.1, None),
        (10.0, 0.59, 0.1, "read the same"),
        (10.0, 0.6, 0.1, "read the same"),
        (10.0, -5.0, 0.001, None),
    ],
)
def test_the_weights_of_a_cell(weight, read, std, text):
    """Their span is at least ten times the noise, and the reading's more than six times its deviation."""
    points = [point(0.0, 0.0, 0.5 * std), point(weight, read, std)]
    if text is None:
        line = cell_line(points, 7.0, 0.1)
        assert line.factor == pytest.approx(weight / read)
        assert line.zero == pytest.approx(0.0, abs=1e-9)
        assert line.residual == pytest.approx(0.0, abs=1e-9)
    else:
        with pytest.raises(CalibrationRefused, match=text):
            cell_line(points, 7.0, 0.1)


@pytest.mark.parametrize(("off", "is_line"), [(1.0, True), (1.11, True), (1.14, False), (-1.14, False)])
def test_weights_on_a_line(off, is_line):
    """The middle of three weights reads too much: the residual is two thirds of it, at most 2 % of 20 N and 0.35 N."""
    points = [point(0.0, 0.0), point(10.0, 10.0 + off), point(20.0, 20.0)]
    if is_line:
        line = cell_line(points, 7.0, 0.35 / 3)
        assert line.residual == pytest.approx(2 / 3 * off, rel=0.02)
        mean = 10.0 + off / 3
        gain = 200.0 / (mean**2 + (10.0 + off - mean) ** 2 + (20.0 - mean) ** 2)  # the least squares
        assert (line.factor, line.zero) == (pytest.approx(gain), pytest.approx(10.0 - gain * mean))
    else:
        with pytest.raises(CalibrationRefused, match=r"not on a line: the largest residual is 0\.7"):
            cell_line(points, 7.0, 0.35 / 3)


@pytest.fixture
def config(tmp_path):
    (tmp_path / "eds").symlink_to(ROBOTS / "eds")
    return RobotConfig.model_validate(description(folder=tmp_path))


def record(config, device="elbow_encoder", identity="canopen:1-2-3", **changes):
    fields = {
        "device": device,
        "identity": identity,
        "settings": {"zero": 0.25},
        "measured_with": store.measured_with(config, device, {"zero": 0.25}),
        "unit": "rad",
        "points": (point(0.0, 1.0),),
        "residual": 0.0,
    }
    return store.sealed(Record(**{**fields, **changes}))


def test_a_calibration_depends_on_the_driver_and_the_settings_that_change_a_reading(config):
    with_zero = store.measured_with(config, "biceps_drive", {})
    assert with_zero["driver"] == "cia402"
    assert {"gear", "counts_per_turn", "spool_radius"} <= set(with_zero)
    assert not set(with_zero) & store.WITHOUT_EFFECT
    assert set(store.measured_with(config, "biceps_drive", {"gear": 1})) == set(with_zero) - {"gear"}


def test_a_seal_covers_every_field(config):
    sealed = record(config)
    assert len(sealed.hash) == 16
    assert sealed.hash == sealed.seal
    changes = {
        "device": "x",
        "identity": "x",
        "settings": {},
        "measured_with": {},
        "unit": "x",
        "points": (),
        "residual": 1.0,
    }
    for name, value in {**changes, "date": "x"}.items():
        assert sealed.model_copy(update={name: value}).seal != sealed.hash
    assert datetime.fromisoformat(sealed.date).utcoffset().total_seconds() == 0.0
    with pytest.raises(ConfigError, match="was edited"):
        store.checked(config, sealed.model_copy(update={"hash": ""}))
    assert store.checked(config, sealed).identity == "canopen:1-2-3"


@pytest.mark.parametrize("change", [{"gear": 999}, {"driver": "mit"}, {"unknown": 1}])
def test_every_condition_is_compared(config, change):
    now = store.measured_with(config, "biceps_drive", {"zero": 0.25})
    changed = record(config, "biceps_drive", measured_with=now | change)
    (name,) = change
    with pytest.raises(ConfigError, match=f"was measured with {name} {change[name]}, the robot file has"):
        store.checked(config, changed)
    missing = {key: value for key, value in now.items() if key != "gear"}
    with pytest.raises(ConfigError, match="with gear not given, the robot file has 29 now"):
        store.checked(config, record(config, "biceps_drive", measured_with=missing))


def test_records_replace_those_of_their_device_and_of_their_identity(config):
    first = record(config, "elbow_encoder", "canopen:1")
    path = store.save(config, first)
    assert not path.with_name(path.name + store.KEPT).exists()  # there was no file before
    store.save(config, record(config, "biceps_cell", "canopen:2"))
    store.save(config, record(config, "triceps_cell", ""))
    saved = yaml.safe_load(path.read_text())
    assert list(saved) == ["canopen:1", "canopen:2", "unknown:triceps_cell"]
    assert list(saved["canopen:1"])[:4] == ["device", "identity", "settings", "measured_with"]  # as a person reads it
    assert path.read_text().startswith("# What `gemuco calibrate` measured")
    store.save(config, record(config, "biceps_drive", "canopen:1"))  # this very device is elsewhere now
    assert {one.device: one.identity for one in store.records(config)} == {
        "biceps_cell": "canopen:2",
        "triceps_cell": "",
        "biceps_drive": "canopen:1",
    }
    kept = yaml.safe_load(path.with_name(path.name + store.KEPT).read_text())
    assert list(kept) == ["canopen:1", "canopen:2", "unknown:triceps_cell"]
    assert kept["canopen:1"]["device"] == "elbow_encoder"
    path.write_text(path.read_text() + "other: 5\n")
    with pytest.raises(ConfigError, match="record 'other'"):
        store.records(config)
    store.save(config, first)  # what is no record stays for a person to see
    assert yaml.safe_load(path.read_text())["other"] == 5


def test_an_empty_file_and_no_file_are_no_calibrations(config):
    assert store.load(config) == {}
    store.path_of(config).write_text("# nothing yet\n")
    assert store.load(config) == {}
    assert store.path_of(config).parent == config.folder


def test_devices_that_could_be_calibrated(config):
    assert store.uncalibrated(config, []) == []  # they are simulated
    body = description(folder=config.folder)
    body["buses"] = {name: {**bus, "interface": "socketcan"} for name, bus in body["buses"].items()}
    real = RobotConfig.model_validate(body)
    names = set(real.devices)
    assert set(store.uncalibrated(real, [])) == names
    assert set(store.uncalibrated(real, ["elbow_encoder"])) == names - {"elbow_encoder"}


def test_a_file_that_cannot_be_written_leaves_the_old_one(config):
    path = store.save(config, record(config))
    before = path.read_text()
    path.with_name(path.name + store.KEPT).mkdir()
    with pytest.raises(ConfigError, match="cannot be saved"):
        store.save(config, record(config, identity="canopen:9"))
    assert path.read_text() == before
    assert sorted(file.name for file in path.parent.iterdir() if file.is_file()) == [path.name]
