"""What is wrong, found by looking: robot files, calibrations, interfaces, nodes; all without hardware."""

from contextlib import contextmanager
from dataclasses import replace

import pytest
from hal_bench import ROBOTS, BenchWorld, description, hardware

from hal.calibration import store
from hal.calibration.store import Point, Record
from hal.config import BusConfig, RobotConfig
from hal.finding import doctor
from hal.finding.doctor import Severity, check_interfaces, check_socketcan
from hal.finding.link import Interface, look_up, parse
from simulators.rig import Rig

SHOWN = {
    "ifname": "can0",
    "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
    "txqlen": 10,
    "link_type": "can",
    "linkinfo": {
        "info_kind": "can",
        "info_data": {"state": "ERROR-ACTIVE", "restart_ms": 100, "bittiming": {"bitrate": 500000}},
    },
}
CAN0 = BusConfig(interface="socketcan", channel="can0")


@contextmanager
def running(nodes=None, **changes):
    config = RobotConfig.model_validate(description(**changes))
    rig = Rig(config, BenchWorld(), nodes or hardware())
    rig.start()
    try:
        yield config, rig
    finally:
        rig.stop()


def by_what(findings):
    return {finding.what: finding for finding in findings}


def verdicts(findings):
    return {finding.what: finding.verdict for finding in findings}


def test_a_robot_that_is_well():
    with running() as (config, _):
        for _ in range(5):  # this machine may be too busy for the nodes to answer in time
            found = by_what([*doctor.check_file(config), *doctor.check_devices(config, 0.2)])
            bad = [finding for finding in found.values() if finding.verdict is Severity.BAD]
            if not bad:
                break
    assert not bad
    assert found["nodes"].text == "All 5 answer."
    assert found["PDO mapping"].text == "Correct in 5 devices."
    assert {"heartbeat", "watchdog", "identity", "bus can0", "budget can1", "calibration"} <= set(found)
    assert "computed" in found["bus can0"].text


def test_nothing_is_enabled_and_everything_is_let_go():
    with running() as (config, rig):
        list(doctor.check_devices(config, 0.1))
        assert {rig.node(spec.name).nmt.name for spec in hardware()} == {"PRE_OPERATIONAL"}
        assert not any(rig.node(name).servo[1] for name in ("biceps_drive", "triceps_drive"))


def test_a_node_without_power_is_told_and_the_others_are_looked_at():
    with running() as (config, rig):
        rig.fault("node_silent triceps_cell")
        found = by_what(doctor.check_devices(config, 0.1))
    assert found["node triceps_cell"].verdict is Severity.BAD
    assert "Is it powered" in found["node triceps_cell"].text
    assert found["nodes"].text == "4 of 5 answer."
    assert found["PDO mapping"].text == "Correct in 4 devices."


def test_a_node_that_answers_but_measures_nothing_is_told():
    with running() as (config, rig):
        rig.fault("sensor_silent triceps_cell")
        found = by_what(doctor.check_devices(config, 0.3))
    assert "sends no process data in 100% of the cycles" in found["node triceps_cell"].text


def test_what_somebody_else_changed_in_a_node_is_told():
    with running() as (config, rig):
        found = {}
        for finding in doctor.check_devices(config, 0.1):
            found[finding.what] = finding
            if finding.what == "nodes":
                rig.node("elbow_encoder").objects.values[0x1017, 0] = 1000
    assert found["heartbeat elbow_encoder"].verdict is Severity.BAD
    assert "1000 ms" in found["heartbeat elbow_encoder"].text


def test_a_simulator_that_does_not_run():
    config = RobotConfig.model_validate(description(interface="hub"))
    found = by_what(doctor.check_devices(config, 0.1))
    assert found["bus can0"].verdict is Severity.BAD
    assert "Start `gemuco simulate`" in found["bus can0"].text
    assert found["nodes"].text.startswith("0 of 5 answer")


def test_a_robot_file_that_cannot_be_built():
    body = description()
    body["kinds"]["drive"]["settings"] = {**body["kinds"]["drive"]["settings"], "gear": 0}
    found = list(doctor.check_file(RobotConfig.model_validate(body)))
    assert [(finding.what, finding.verdict) for finding in found] == [("robot file", Severity.BAD)]
    assert "gear" in found[0].text


def with_a_record(folder, **changes):
    """A robot in a folder of its own, with one calibration."""
    (folder / "eds").symlink_to(ROBOTS / "eds")
    config = RobotConfig.model_validate(description(folder=folder))
    settings = {"zero": 0.1, "direction": 1}
    body = {
        "device": "elbow_encoder",
        "identity": "canopen:1-2-3",
        "settings": settings,
        "measured_with": store.measured_with(config, "elbow_encoder", settings),
        "unit": "rad",
        "points": (Point(known=0.0, read=1.0, std=0.0, samples=9),),
        "residual": 0.0,
    }
    store.save(config, store.sealed(Record(**{**body, **changes})))
    return config


def test_a_calibration_that_holds(tmp_path):
    found = doctor.check_calibration(with_a_record(tmp_path))
    assert found.verdict is Severity.OK
    assert "1 devices, the oldest of 20" in found.text


def test_a_calibration_that_does_not_hold_is_told_and_the_devices_are_looked_at(tmp_path):
    config = with_a_record(tmp_path, measured_with={"driver": "cia406", "counts_per_turn": 4096})
    assert "was measured with counts_per_turn 4096" in doctor.check_calibration(config).text
    rig = Rig(config, BenchWorld(), hardware())
    rig.start()
    try:
        assert by_what(doctor.check_devices(config, 0.1))["nodes"].verdict is Severity.OK
    finally:
        rig.stop()


def test_a_device_that_cannot_tell_who_it_is(tmp_path):
    found = doctor.check_calibration(with_a_record(tmp_path, identity=""))
    assert found.verdict is Severity.WARNING
    assert "elbow_encoder have no identity" in found.text


def test_devices_on_real_buses_without_a_calibration_are_told():
    found = doctor.check_calibration(RobotConfig.model_validate(description(interface="socketcan")))
    assert found.verdict is Severity.WARNING
    assert "biceps_drive, triceps_drive" in found.text and "gemuco calibrate" in found.text


def test_a_replaced_device_is_told(tmp_path):
    config = with_a_record(tmp_path)
    rig = Rig(config, BenchWorld(), hardware())
    rig.start()
    try:
        found = by_what(doctor.check_devices(config, 0.1))
    finally:
        rig.stop()
    assert "Was it replaced?" in found["node elbow_encoder"].text


def test_what_ip_prints_is_read():
    assert parse([{}, SHOWN]) == Interface("can0", True, True, "can", 500000, 0.1, "ERROR-ACTIVE", 10)
    virtual = {**SHOWN, "ifname": "vcan0", "linkinfo": {"info_kind": "vcan"}}
    assert parse([virtual]) == Interface("vcan0", True, True, "vcan", None, None, "", 10)
    data = {**SHOWN["linkinfo"]["info_data"], "ctrlmode": ["FD"], "data_bittiming": {"bitrate": 4_000_000}}
    wide = parse([{**SHOWN, "mtu": 72, "linkinfo": {"info_kind": "can", "info_data": data}}])
    assert (wide.bitrate, wide.data_bitrate, wide.mtu) == (500000, 4_000_000, 72)
    with pytest.raises(LookupError):
        parse([])


@pytest.mark.parametrize(
    ("changes", "what", "verdict", "said"),
    [
        ({}, "interface can0", Severity.OK, "is up"),
        ({"is_up": False}, "interface can0", Severity.BAD, "type can bitrate 1000000 restart-ms 100"),
        ({"is_can": False}, "interface can0", Severity.BAD, "not a CAN interface"),
        ({"bitrate": 500000}, "bit rate can0", Severity.BAD, "500000 bit/s, and the robot file says 1000000"),
        ({"restart": 0.0}, "restart can0", Severity.WARNING, "stays off after bus-off"),
        ({"state": "ERROR-PASSIVE"}, "controller can0", Severity.WARNING, "terminations"),
        ({"state": "BUS-OFF"}, "controller can0", Severity.BAD, "terminations"),
        ({"queue": 3}, "queue can0", Severity.WARNING, "txqueuelen"),
        ({"kind": "vcan", "bitrate": None, "restart": None}, "interface can0", Severity.OK, "vcan"),
    ],
)
def test_a_linux_interface(changes, what, verdict, said):
    sound = Interface("can0", True, True, "can", 1_000_000, 0.1, "ERROR-ACTIVE", 100)
    found = by_what(check_socketcan("interface can0", CAN0, replace(sound, **changes), 5))
    assert found[what].verdict is verdict
    assert said in found[what].text


@pytest.mark.parametrize(
    ("changes", "what", "verdict", "said"),
    [
        ({}, "bit rate of data can0", Severity.OK, "5000 kbit/s"),
        ({"data_bitrate": 2_000_000}, "bit rate of data can0", Severity.BAD, "bitrate 1000000 dbitrate 5000000 fd on"),
        ({"mtu": 16, "data_bitrate": None}, "interface can0", Severity.BAD, "classic frames only"),
        ({"mtu": 16, "kind": "vcan"}, "interface can0", Severity.BAD, "ip link set can0 mtu 72 up"),
    ],
)
def test_a_linux_interface_for_can_fd(changes, what, verdict, said):
    bus = CAN0.model_copy(update={"data_bitrate": 5_000_000})
    sound = Interface("can0", True, True, "can", 1_000_000, 0.1, "ERROR-ACTIVE", 100, 5_000_000, 72)
    found = by_what(check_socketcan("interface can0", bus, replace(sound, **changes), 5))
    assert found[what].verdict is verdict
    assert said in found[what].text


def test_an_interface_that_is_not_there():
    assert look_up("can_that_is_not") is None
    (found,) = check_socketcan("interface can0", CAN0, None, 5)
    assert found.verdict is Severity.BAD
    assert "CAN interfaces here:" in found.text


def test_interfaces_that_are_no_hardware_say_so():
    report = verdicts(check_interfaces(RobotConfig.model_validate(description())))
    assert report == {"interface can0": Severity.WARNING, "interface can1": Severity.WARNING}
    report = verdicts(check_interfaces(RobotConfig.model_validate(description(interface="hub"))))
    assert set(report.values()) == {Severity.OK}


def asked(**changes):
    """What the doctor says of limits, by its subject; nothing is opened."""
    found = doctor.check_file(RobotConfig.model_validate(description(**changes)))
    return {finding.what: finding for finding in found if finding.what.startswith(("limits", "rate"))}


@pytest.mark.parametrize(
    ("limits", "report"),
    [
        ({"joint_position": {"trip_high": 2.0}}, "Likely for joint_position"),
        (
            {"joint_position": {"low": -90, "high": 90}},
            "may go to 90 rad, which is more than two turns. Are these deg?",
        ),
        ({"muscle_length": {"low": 100, "high": 500}}, "may go to 500 m, which is more than 20 m. Are these mm?"),
        ({"muscle_length": {"low": 0.1, "high": 0.5, "rate": 250}}, "may move at 250 m/s. Are these mm?"),
    ],
)
def test_limits_that_are_unlikely_are_asked_about(limits, report):
    found = asked(limits=limits)["limits"]
    assert report in found.text
    assert (found.verdict is Severity.OK) == report.startswith("Likely")


def test_a_rate_that_the_drive_cannot_reach_is_asked_about():
    kinds = description()["kinds"]
    kinds["drive"]["settings"] = {**kinds["drive"]["settings"], "max_velocity": 0.2}
    found = asked(kinds=kinds)
    assert "allows 0.25 m/s, and the drive moves at most at 0.2 m/s" in found["rate biceps_drive"].text
    assert found["rate biceps_drive"].verdict is Severity.WARNING


def test_the_drive_is_asked_for_its_fastest_speed():
    with running() as (config, rig):
        assert "rate biceps_drive" not in asked()
        rig.node("biceps_drive").objects.values[0x6080, 0] = 4000  # turns of the motor per minute: 0.116 m/s
        found = by_what(doctor.check_devices(config, 0.1))
    assert "the drive moves at most at 0.1156 m/s" in found["rate biceps_drive"].text
    assert "rate triceps_drive" not in found
