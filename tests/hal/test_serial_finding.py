"""Servos on a serial line are found: by the scan, by the doctor, and for a drafted robot file."""

import time
from collections import Counter

import pytest
import yaml
from serial_bench import NAMES, SETTINGS, SerialBench, robot_file

from hal.config import BusConfig, RobotConfig
from hal.errors import BusGone
from hal.finding import serial_scan
from hal.finding.doctor import Severity, check_devices, check_interfaces
from hal.finding.draft.draft import draft_bus
from hal.finding.scan import compare
from hal.finding.serial_scan import scan_line
from hal.protocols import feetech
from hal.robot import open_robot
from simulators.robots.bench import simulator

by_make = pytest.mark.parametrize("make", SETTINGS)


@by_make
@pytest.mark.long
def test_a_scan_lists_the_servos_and_compares_them(make):
    bench = SerialBench(make, robot_file(make))
    bench.plug()
    try:
        result = scan_line("arm", bench.config.buses["arm"])
        assert [node.node for node in result.nodes] == [1, 2, 5]
        assert {node.protocol for node in result.nodes} == {make.capitalize()}
        expected = {"feetech": "STS3215, firmware 3.9, 7.4 V, 31 degC", "dynamixel": "XM430-W350, firmware 45, 11.9 V"}
        assert all(node.state.startswith(expected[make]) for node in result.nodes)
        assert compare(result, bench.config) == []
        other = "dynamixel" if make == "feetech" else "feetech"
        differences = compare(result, robot_file(other))
        assert len(differences) == 3 and f"the robot file says {other}" in differences[0]
        bench.rig.fault("node_silent lift_servo")
        differences = compare(scan_line("arm", bench.config.buses["arm"]), bench.config)
        assert differences == ["arm: node 2 ('lift_servo') was not found. Is it powered, is its node id right?"]
        for name in NAMES:
            bench.rig.fault(f"node_silent {name}_servo")
        with pytest.raises(BusGone, match="No servo answers on 'arm' at 1000000 bit/s"):
            scan_line("arm", bench.config.buses["arm"])
    finally:
        bench.unplug()


@pytest.mark.slow
def test_a_servo_whose_answer_is_lost_once_is_found_all_the_same(monkeypatch):
    asked, ask = Counter(), serial_scan._ask

    def lossy(port, packet, node, reader):
        asked[packet] += 1
        status = ask(port, packet, node, reader)
        return None if packet == feetech.ping(2) and asked[packet] == 1 else status

    monkeypatch.setattr(serial_scan, "_ask", lossy)
    bench = SerialBench("feetech", robot_file("feetech"))
    bench.plug()
    try:
        result = scan_line("arm", bench.config.buses["arm"])
    finally:
        bench.unplug()
    assert [node.node for node in result.nodes] == [1, 2, 5]
    assert asked[feetech.ping(1)] == 1
    assert asked[feetech.ping(2)] == 2


@by_make
@pytest.mark.long
def test_the_doctor_checks_a_line(make):
    bench = SerialBench(make, robot_file(make))
    bench.plug()
    try:
        findings = [*check_interfaces(bench.config), *check_devices(bench.config, 0.5)]
    finally:
        bench.unplug()
    bad = [finding for finding in findings if finding.verdict is Severity.BAD]
    if make == "feetech":
        assert len(bad) == 3 and all("no watchdog" in finding.text for finding in bad)
    else:
        assert bad == []
    assert any(finding.what == "cycles" and "All of them answered in" in finding.text for finding in findings)


def test_the_doctor_names_the_adapters_that_are_there():
    config = robot_file("feetech", buses={"arm": {"interface": "serial", "channel": "/dev/ttyNONE"}})
    (finding,) = check_interfaces(config)
    assert finding.verdict is Severity.BAD
    assert finding.text.startswith("There is no '/dev/ttyNONE'. Adapters here: ")


@by_make
@pytest.mark.long
def test_a_scan_becomes_a_robot_file_that_runs(make, tmp_path):
    bench = SerialBench(make, robot_file(make))
    bench.plug()
    try:
        result = scan_line("arm", bench.config.buses["arm"])
    finally:
        bench.unplug()
    draft = draft_bus(
        result, "interface: serial, channel: /dev/ttyACM0", BusConfig(channel="x"), None, "mine", tmp_path, tmp_path
    )
    body = yaml.safe_load(draft.text)
    assert body["buses"]["arm"]["interface"] == "pty"
    body["buses"]["arm"]["channel"] = str(tmp_path / "line")
    config = RobotConfig.model_validate(body)
    rig = simulator.rig(config, "bench", 0)
    rig.start()
    try:
        with open_robot(config) as robot:
            end = time.monotonic() + 20.0
            while time.monotonic() < end:
                sample, _ = robot.cycle()
                if sample.complete and all(valid.all() for valid in sample.valid.values()):
                    break
                time.sleep(robot.period)
            assert {device["state"] for device in robot.health()["devices"].values()} == {"ready"}
    finally:
        rig.stop()
    if make == "feetech":
        assert len(draft.notes) == 1 and "no watchdog" in draft.notes[0]
