"""What was measured of a device: fitted, stored under its identity, and refused when it does not hold any more."""

import threading
import time

import numpy as np
import pytest
import yaml
from hal_bench import ROBOTS, BenchWorld, description, hardware

from hal.calibration import store
from hal.calibration.line import CalibrationLine, CalibrationRefused, cell_line, joint_line
from hal.calibration.store import Point, Record
from hal.clock import SystemClock
from hal.config import RobotConfig
from hal.errors import ConfigError, DeviceSilent, WrongDevice
from hal.finding.measuring import Measurement, subject
from hal.fleet import build
from hal.robot import open_robot
from simulators.rig import Rig


@pytest.fixture
def config(tmp_path):
    """A robot whose file lies in a folder of its own."""
    (tmp_path / "eds").symlink_to(ROBOTS / "eds")
    return RobotConfig.model_validate(description(folder=tmp_path))


@pytest.fixture
def rig(config):
    """The nodes, in real time."""
    rig = Rig(config, BenchWorld(), hardware())
    rig.start()
    yield rig
    rig.stop()


def point(known, read, std=0.001):
    return Point(known=known, read=read, std=std, samples=100)


def a_record(config, device="elbow_encoder", identity="canopen:1-2-3"):
    settings = {"zero": 0.25, "direction": -1}
    known = device in config.devices
    return store.sealed(
        Record(
            device=device,
            identity=identity,
            settings=settings,
            measured_with=store.measured_with(config, device, settings) if known else {},
            unit="rad",
            points=(point(0.0, 1.0),),
            residual=0.0,
        )
    )


def settle(rig, **values):
    """Set what the world is, and wait until the nodes have taken it up."""
    for name, value in values.items():
        getattr(rig._world, name)[0] = value
    steps = rig.stats()["physics"]["steps"]
    deadline = time.monotonic() + 20.0
    while rig.stats()["physics"]["steps"] < steps + 2:
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_one_position_gives_the_zero_and_keeps_the_direction():
    line = joint_line([point(0.5, 2.0)], -1, 0.1)
    assert (line.factor, line.zero) == (-1, 2.5)
    assert line.value(1.0) == 1.5


def test_two_positions_give_zero_and_direction():
    line = joint_line([point(0.0, 2.0), point(1.0, 1.02)], 1, 0.1)
    assert line.factor == -1
    assert line.zero == pytest.approx(2.01)
    assert line.residual == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ([point(0.0, 1.0), point(0.05, 1.05)], "move by at least 0.1"),
        ([point(0.0, 1.0), point(1.0, 1.001)], "Is it the device of this joint"),
        ([point(0.0, 1.0), point(1.0, 3.0)], "wrong by a factor of 2"),
    ],
)
def test_positions_that_tell_nothing_are_refused(points, said):
    with pytest.raises(CalibrationRefused, match=said):
        joint_line(points, 1, 0.1)


def test_weights_give_zero_gain_and_residual():
    line = cell_line([point(0.0, 3.0), point(10.0, 8.0), point(20.0, 13.02)], 1.0, 0.1)
    assert line.factor == pytest.approx(2.0, rel=2e-3)
    assert line.value(3.0) == pytest.approx(0.0, abs=0.02)
    assert 0 < line.residual < 0.02


def test_a_tare_keeps_the_gain():
    line = cell_line([point(0.0, 3.0)], 2.0, 0.1)
    assert (line.factor, line.zero) == (2.0, -6.0)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ([point(5.0, 3.0), point(5.2, 3.1)], "not ten times the noise"),
        ([point(0.0, 3.0), point(10.0, 3.002)], "read the same"),
        ([point(0.0, 0.0), point(10.0, 10.0), point(20.0, 25.0)], "not on a line"),
    ],
)
def test_weights_that_tell_nothing_are_refused(points, said):
    with pytest.raises(CalibrationRefused, match=said):
        cell_line(points, 1.0, 0.1)


def test_what_is_stored_is_laid_over_the_robot_file(config):
    path = store.save(config, a_record(config))
    assert path.name == "bench.calibration.yaml"
    found = store.load(config)["elbow_encoder"]
    assert found.identity == "canopen:1-2-3"
    assert dict(found.settings) == {"zero": 0.25, "direction": -1}
    raw = yaml.safe_load(path.read_text())
    assert list(raw) == ["canopen:1-2-3"]
    assert raw["canopen:1-2-3"]["date"]


def test_the_file_before_is_kept_and_other_records_stay(config):
    store.save(config, a_record(config))
    path = store.save(config, a_record(config, device="biceps_drive", identity="canopen:1-2-4"))
    assert set(store.load(config)) == {"elbow_encoder", "biceps_drive"}
    before = yaml.safe_load(path.with_name(path.name + store.KEPT).read_text())
    assert list(before) == ["canopen:1-2-3"]
    names = [file.name for file in path.parent.iterdir() if file.is_file()]
    assert sorted(names) == ["bench.calibration.yaml", "bench.calibration.yaml.before"]


def test_a_replaced_device_takes_the_place_of_the_one_before(config):
    store.save(config, a_record(config))
    store.save(config, a_record(config, identity="canopen:1-2-9"))
    assert [record.identity for record in store.records(config)] == ["canopen:1-2-9"]


def test_a_record_that_was_edited_is_refused(config):
    path = store.save(config, a_record(config))
    path.write_text(path.read_text().replace("zero: 0.25", "zero: 0.26"))
    with pytest.raises(ConfigError, match=r"calibration of 'elbow_encoder' .* was edited: its hash does not fit"):
        build(config, SystemClock())


def test_a_record_is_refused_when_what_it_was_measured_with_changed(config):
    store.save(config, a_record(config, device="biceps_drive"))
    body = description(folder=config.folder)
    body["kinds"]["drive"]["settings"] = {**body["kinds"]["drive"]["settings"], "gear": 50}
    with pytest.raises(ConfigError, match="was measured with gear 29, the robot file has 50 now"):
        store.load(RobotConfig.model_validate(body))
    body["kinds"]["drive"]["settings"] = {**body["kinds"]["drive"]["settings"], "gear": 29, "silent_after": 0.3}
    assert store.load(RobotConfig.model_validate(body))


def test_a_setting_that_was_not_there_counts_as_changed(config):
    store.save(config, a_record(config))
    body = description(folder=config.folder)
    body["kinds"]["encoder"]["settings"] = {**body["kinds"]["encoder"]["settings"], "counts_per_turn": 4096}
    with pytest.raises(ConfigError, match="counts_per_turn not given, the robot file has 4096 now"):
        store.load(RobotConfig.model_validate(body))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "cannot be read"),
        ("- 1", "are not a mapping"),
        ("a: 1", "record 'a'"),
        ("a: {device: x, gravity: 9.81}", "unknown key 'gravity'"),
    ],
)
def test_a_file_that_is_none_is_refused(config, text, said):
    store.path_of(config).write_text(text)
    with pytest.raises(ConfigError, match=said):
        store.load(config)


def test_a_file_that_cannot_be_written_is_told(config, tmp_path):
    record = a_record(config)
    with pytest.raises(ConfigError, match="cannot be saved"):
        store.save(config.model_copy(update={"folder": tmp_path / "nowhere"}), record)


def test_a_record_of_a_device_that_is_gone_is_passed_over(config):
    store.save(config, a_record(config, device="shoulder_encoder"))
    assert store.load(config) == {}


def test_an_encoder_tells_the_truth_after_one_position(config, rig):
    what = subject(config, "elbow_encoder", "direction")
    settle(rig, angle=-0.7)
    with Measurement(what) as device:
        seen = device.measure(0.3, 0.2, 0.005)
        store.save(config, device.record(joint_line([seen], device.now.factor, 0.1), (seen,)))
        assert device.identity.startswith("canopen:")
    with open_robot(config) as robot:
        for _ in range(2000):
            sample, _ = robot.cycle()
            if np.isfinite(sample.values["joint_position"]).all():
                break
            robot.clock.sleep_until(robot.clock.monotonic() + robot.period)
        assert sample.values["joint_position"] == pytest.approx([0.3], abs=1e-3)  # rad
        assert robot.mode == "off"


@pytest.mark.long
def test_a_cell_tells_the_truth_after_three_weights_and_keeps_its_gain_at_a_tare(config, rig):
    what = subject(config, "muscle_tension.biceps", "gain")
    assert (what.device, what.unit) == ("biceps_cell", "N")
    points = []
    with Measurement(what) as device:
        for known, report in ((0.0, 2.0), (10.0, 14.5), (20.0, 27.0)):  # N
            settle(rig, tension=report)
            points.append(device.measure(known, 0.2, 0.1))
        line = cell_line(points, device.now.factor, 0.1)
        store.save(config, device.record(line, tuple(points)))
        assert line.factor == pytest.approx(0.8, rel=1e-3)
        assert device.now.factor == pytest.approx(0.8, rel=1e-3)
        settle(rig, tension=4.5)
        bare = device.measure(0.0, 0.2, 0.1)
        tared = cell_line([bare], device.now.factor, 0.1)
    assert tared.factor == line.factor
    assert tared.value(points[2].read) == pytest.approx(18.0, abs=0.05)  # N


@pytest.mark.long
def test_a_drive_waits_for_the_next_position_without_a_fault_and_without_power(config, rig):
    with Measurement(subject(config, "biceps_drive", "direction")) as device:
        first = device.measure(0.3, 0.1, 0.001)
        time.sleep(0.8)  # a person moves the joint; the drive's watchdog is shorter
        settle(rig, length=0.34)
        second = device.measure(0.34, 0.1, 0.001)
        assert rig.node("biceps_drive").objects.values[0x1001, 0] == 0
        assert not rig.node("biceps_drive").servo[1]
    assert joint_line([first, second], -1, 0.01).factor == 1


@pytest.mark.long
def test_an_encoder_that_lost_its_power_in_between_is_opened_again(config, rig):
    with Measurement(subject(config, "elbow_encoder", "direction")) as device:
        first = device.measure(0.3, 0.1, 0.005)
        rig.fault("node_reboot elbow_encoder")
        assert device.measure(0.3, 0.1, 0.005).read == pytest.approx(first.read)


@pytest.mark.long
def test_a_device_that_moves_or_brings_nothing_is_refused(config, rig):
    with Measurement(subject(config, "biceps_cell", "gain")) as device:
        noise, over = np.random.default_rng(0), threading.Event()

        def shake():
            while not over.wait(0.005):
                rig._world.tension[0] = noise.normal(20.0, 2.0)

        thread = threading.Thread(target=shake)
        thread.start()
        try:
            with pytest.raises(CalibrationRefused, match="does not stand still"):
                device.measure(0.0, 0.3, 0.1)
        finally:
            over.set()
            thread.join()
        settle(rig, tension=900.0)
        with pytest.raises(CalibrationRefused, match=r"sent 0 values .*overload"):
            device.measure(0.0, 0.1, 0.1)


def test_another_device_in_the_place_of_the_one_that_was_calibrated_is_refused(config, rig):
    store.save(config, a_record(config))
    _, devices = build(config, SystemClock())
    encoder = next(device for device in devices if device.name == "elbow_encoder")
    encoder._bus.open()
    with pytest.raises(WrongDevice, match=r"its calibration is of canopen:1-2-3. Was it replaced\?"):
        encoder.open()
    encoder._bus.close()


def test_an_encoder_that_would_begin_again_within_the_limits_is_told(config):
    limits = {**description()["limits"], "joint_position": {"low": -1.0, "high": 1.0}}
    what = subject(RobotConfig.model_validate(description(limits=limits)), "elbow_encoder", "direction")
    assert "begin again at 0.5 rad" in what.wrap(CalibrationLine(0.5, 1, 0.0))
    assert "`around: 0`" in what.wrap(CalibrationLine(0.5, -1, 0.0))
    assert not what.wrap(CalibrationLine(-3.0, 1, 0.0))
    assert not subject(config, "elbow_encoder", "direction").wrap(CalibrationLine(0.5, 1, 0.0))  # it has no limits


def test_limits_are_turned_into_what_the_device_reads():
    body = description()
    body["devices"]["triceps_drive"]["settings"] = {"zero": 0.2, "direction": -1}
    what = subject(RobotConfig.model_validate(body), "triceps_drive", "direction")
    limit = what.limits()["muscle_length"]
    assert limit.low == pytest.approx((0.1, -0.3))
    assert limit.high == pytest.approx((0.5, 0.1))
    assert limit.rate == 0.25


def test_what_cannot_be_calibrated_is_told(config):
    with pytest.raises(ConfigError, match=r"'knee' is neither a device nor an element of one\. Devices: biceps_drive"):
        subject(config, "knee", "direction")
    with pytest.raises(ConfigError, match=r"has no setting 'gain' .* `gemuco calibrate joint`"):
        subject(config, "elbow_encoder", "gain")
    with pytest.raises(ConfigError, match=r"has no setting 'direction' .* `gemuco calibrate cell`"):
        subject(config, "biceps_cell", "direction")


@pytest.mark.long
def test_a_device_that_is_silent_is_told(config):
    with (
        pytest.raises(DeviceSilent, match="'elbow_encoder'"),
        Measurement(subject(config, "elbow_encoder", "direction")),
    ):
        raise AssertionError("nobody is there")


def test_the_hash_does_not_depend_on_the_order_of_settings():
    """An editor may sort the keys of the file."""
    fields = {"device": "elbow", "identity": "a:1", "unit": "rad", "points": (), "residual": 0.0}
    settings = {"zero": 0.1, "direction": -1}
    seals = {
        Record(**fields, settings=dict(order), measured_with=dict(order)).seal
        for order in ([*settings.items()], [*reversed(settings.items())])
    }
    assert len(seals) == 1
    other = Record(**fields, settings={**settings, "zero": 0.2}, measured_with=settings)
    assert other.seal not in seals
