"""Drivers and their nodes on vcan0 and vcan1 of a real kernel, and everything that such an interface can do to them.

`make test-socketcan` runs this in a kernel that has them; elsewhere it is skipped.
"""

import re
import shutil
import subprocess
import time
from pathlib import Path

import canopen
import numpy as np
import pytest
from kernel_robot import (
    EDS,
    NEEDS_CAN_UTILS,
    RATE,
    Master,
    Nodes,
    description,
    ip,
    one_muscle,
    running,
    send_error_frame,
    write,
)

pytestmark = [
    pytest.mark.skipif(
        not all(Path("/sys/class/net", name).exists() for name in ("vcan0", "vcan1")),
        reason="no vcan0 and vcan1 on this machine; `make test-socketcan` boots a kernel that has them",
    ),
    pytest.mark.timeout(240),
]


@pytest.fixture(scope="module")
def started(tmp_path_factory):
    forces = ("set muscle_tension.biceps 40", "set muscle_tension.triceps 25", "set muscle_tension.deltoid 15")
    with running(tmp_path_factory.mktemp("robot"), description(), *forces, "set joint_position.elbow 0.5") as both:
        yield both


@pytest.fixture
def master(started) -> Master:
    master, _ = started
    yield master
    master.target = None
    if master.robot.mode in ("hold", "follow"):
        master.robot.disable()
    master.until_whole("whole again after the test")
    drives = ("biceps_drive", "triceps_drive")
    master.until(lambda: all(master.device(name)["state"] == "ready" for name in drives), "let go after the test")
    if master.robot.mode == "fault":
        master.robot.reset()
    master.until(lambda: master.robot.mode == "off", "off after the test")


@pytest.fixture
def nodes(started) -> Nodes:
    return started[1]


def test_values_come_through_the_kernel_and_bear_its_stamps(master):
    values = master.sample.values
    assert values["muscle_length"] == pytest.approx([0.3, 0.3], abs=1e-4)  # m
    assert values["muscle_tension"] == pytest.approx([40.0, 25.0, 15.0], abs=0.05)  # N
    assert values["joint_position"] == pytest.approx([0.5], abs=1e-4)  # rad
    assert {master.bus(name)["stamps"] for name in ("can0", "can1")} == {"kernel"}


def test_the_drives_follow_and_let_go(master):
    master.enable()
    master.target = np.array([0.33, 0.28])
    master.until(lambda: np.allclose(master.sample.values["muscle_length"], master.target, atol=1e-3), "there")
    master.robot.disable()
    master.until(lambda: master.robot.mode == "off", "off")


@NEEDS_CAN_UTILS
def test_the_kernel_keeps_away_what_nobody_wants(master):
    received = Path("/proc/net/can/rcvlist_sff").read_text()
    assert "vcan0" in received
    before = master.bus("can0")["counters"]
    frames = 200
    subprocess.run(["cangen", "vcan0", "-I", "333", "-g", "1", "-n", str(frames)], check=True)
    time.sleep(4 / RATE)
    after = master.bus("can0")["counters"]
    assert after["unknown"] == before["unknown"]
    assert after["received"] - before["received"] < frames


@NEEDS_CAN_UTILS
def test_candump_reads_our_traffic(master):
    dump = subprocess.run(["candump", "-L", "-n", "40", "-T", "20000", "vcan0"], capture_output=True, text=True)
    heard = re.findall(r"^\((\d+\.\d+)\) vcan0 ([0-9A-F]{3})#([0-9A-F]*)$", dump.stdout, re.MULTILINE)
    assert len(heard) == 40
    sizes = {int(identifier, 16): len(data) // 2 for _, identifier, data in heard}
    assert sizes[0x080] == 0, "SYNC"
    assert sizes[0x181] >= 6, "statusword and position of the drive"
    assert sizes[0x18B] == 5, "tension and status of the cell"
    cell = next(bytes.fromhex(data) for _, identifier, data in heard if identifier == "18B")
    assert int.from_bytes(cell[:4], "little", signed=True) == pytest.approx(4000, abs=2)  # hundredths of a newton
    assert set(sizes) <= {0x080, 0x181, 0x201, 0x281, 0x301, 0x18B, 0x701, 0x70B, 0x77F}


def test_canopen_reads_nodes_and_process_data(master):
    network = canopen.Network()
    network.connect(interface="socketcan", channel="vcan0")
    try:
        cell = network.add_node(11, str(EDS / "load_cell.eds"))
        cell.sdo.RESPONSE_TIMEOUT = 5.0
        assert cell.sdo[0x1000].raw & 0xFFFF == 404
        assert cell.sdo[0x6131][1].raw == 0x00210000
        cell.tpdo.read()
        assert cell.tpdo[1].cob_id == 0x18B
        assert cell.tpdo[1].wait_for_reception(10.0) is not None
        assert cell.tpdo[1]["AI input PV 32 bit.AI input PV 32 bit 1"].raw == pytest.approx(4000, abs=2)
        drive = network.add_node(1, str(EDS / "servo_drive.eds"))
        drive.sdo.RESPONSE_TIMEOUT = 5.0
        assert drive.sdo[0x1016][1].raw == 127 << 16 | 2000, "the drive watches our heartbeat"
    finally:
        network.disconnect()


def test_a_link_that_goes_down_stops_the_robot_and_comes_back(master):
    master.enable()
    ip("link", "set", "vcan0", "down")
    try:
        master.until(lambda: master.bus("can0")["state"] == "gone", "gone")
        master.until(lambda: not master.sample.valid["muscle_tension"][0], "not valid")
        master.until(lambda: master.robot.mode in ("fault", "off"), "stopped")
        master.until(lambda: master.sample.valid["muscle_tension"][1], "the other bus goes on")
    finally:
        ip("link", "set", "vcan0", "up")
    master.until(lambda: master.bus("can0")["state"] == "ok", "back")
    master.until_whole("whole again")
    assert master.robot.mode != "hold", "nothing enables itself"


def test_an_interface_that_is_unplugged_and_plugged_in_again(master, nodes):
    opened = master.bus("can1")["counters"]["opened"]
    ip("link", "del", "vcan1")
    try:
        master.until(lambda: master.bus("can1")["state"] == "gone", "gone")
        master.until(lambda: not master.sample.valid["joint_position"][0], "not valid")
    finally:
        ip("link", "add", "vcan1", "type", "vcan")
        ip("link", "set", "vcan1", "up")
    master.until_whole("whole again")
    assert master.bus("can1")["counters"]["opened"] > opened


@pytest.mark.parametrize(
    ("kind", "data", "state"),
    [
        (0x004, b"\0\x04\0\0\0\0\0\0", "warning"),
        (0x004, b"\0\x30\0\0\0\0\x80\x00", "passive"),
        (0x020, bytes(8), "warning"),
    ],
)
def test_what_a_controller_says_of_itself(master, kind, data, state):
    send_error_frame("vcan1", kind, data)
    master.until(lambda: master.bus("can1")["state"] == state, state)
    send_error_frame("vcan1", 0x100)
    master.until(lambda: master.bus("can1")["state"] == "ok", "ok again")


def test_bus_off_stops_the_robot_until_it_is_restarted(master):
    master.enable()
    send_error_frame("vcan0", 0x040)
    master.until(lambda: master.robot.mode in ("fault", "off"), "stopped")
    send_error_frame("vcan0", 0x100)
    master.until(lambda: master.bus("can0")["state"] == "ok", "ok again")
    assert master.robot.mode != "hold", "nothing enables itself"


def test_a_frozen_node_process_is_silent_and_not_believed(master, nodes):
    master.enable()
    nodes.freeze()
    try:
        master.until(lambda: master.device("biceps_cell")["state"] == "silent", "silent")
        assert not any(valid.any() for valid in master.sample.valid.values())
        master.until(lambda: master.robot.mode in ("fault", "off"), "stopped")
    finally:
        nodes.thaw()
    master.until_whole("whole again")
    assert master.robot.mode != "hold", "nothing enables itself"


@NEEDS_CAN_UTILS
def test_frames_of_all_lengths_and_kinds_from_a_stranger(master):
    malformed = master.device("biceps_cell")["counters"]["malformed"]
    lines = ["18B#", "18B#01", "18B#0102030405060708", "70B#", "08B#01", "58B#00", "000#", "18B#R", "0000018B#0102"]
    for line in lines:
        subprocess.run(["cansend", "vcan0", line], check=True)
    master.until(lambda: master.device("biceps_cell")["counters"]["malformed"] >= malformed + 3, "counted")
    master.until_whole("whole")
    assert master.sample.values["muscle_tension"][0] == pytest.approx(40.0, abs=0.05)


@pytest.mark.skipif(shutil.which("tc") is None, reason="no tc (package iproute2)")
@pytest.mark.parametrize("trouble", ["loss 10%", "duplicate 20%", "delay 4ms 3ms"])
def test_a_wire_that_loses_doubles_and_shuffles(tmp_path, trouble):
    ip("link", "add", "vx0", "type", "vxcan", "peer", "name", "vx1")
    try:
        ip("link", "set", "vx0", "up")
        ip("link", "set", "vx1", "up")
        raw, node_raw = one_muscle("vx0"), one_muscle("vx1")
        folder = tmp_path / "nodes"
        folder.mkdir()
        node_file = write(folder, node_raw)
        with running(tmp_path, raw, node_file=node_file) as (master, _):
            for end in ("vx0", "vx1"):
                subprocess.run(["tc", "qdisc", "add", "dev", end, "root", "netem", *trouble.split()], check=True)
            begin = master.sample.cycle
            seen = []
            while master.sample.cycle < begin + 60:
                sample = master.sample
                if not seen or sample is not seen[-1]:
                    seen.append(sample)
                time.sleep(0.01)
            assert any(sample.valid["muscle_tension"].all() for sample in seen)
            for sample in seen:
                if sample.valid["muscle_tension"].all():
                    assert sample.values["muscle_tension"] == pytest.approx([0.0], abs=0.05)
    finally:
        ip("link", "del", "vx0")
