"""Controller states of a real kernel (can_dev): reported by a serial adapter, and on emulated SJA1000 controllers.

What cannot be had without hardware: a bus-off that comes from wiring, and a controller that `restart-ms` brings back.
The emulated SJA1000 acknowledges its own frames and hears a peer at any bit rate, and slcan has no restart.
"""

import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest
from kernel_robot import NEEDS_CAN_UTILS, Master, ip, one_muscle, running, write
from serial_adapter import SerialAdapter

NET = Path("/sys/class/net")


def pair(folder: Path, near: str, far: str):
    """Master on one interface, nodes on another."""
    there = folder / "nodes"
    there.mkdir()
    return running(folder, one_muscle(near), "set muscle_tension.biceps 40", node_file=write(there, one_muscle(far)))


def facts(channel: str) -> dict:
    """What the kernel holds of an interface."""
    completed = subprocess.run(
        ["ip", "-j", "-d", "-s", "link", "show", channel], capture_output=True, text=True, check=True
    )
    return json.loads(completed.stdout)[0]


@pytest.fixture(scope="module")
def adapted(tmp_path_factory) -> Iterator[tuple[Master, SerialAdapter]]:
    """The kernel's own state machine, fed by an adapter that is ours."""
    if not (NET / "vcan0").exists():
        pytest.skip("no vcan0 on this machine; `make test-socketcan` boots a kernel that has it")
    if shutil.which("slcand") is None:
        pytest.skip("no slcand (package can-utils)")
    adapter = SerialAdapter("slc0", "vcan0")
    try:
        with pair(tmp_path_factory.mktemp("robot"), "slc0", "vcan0") as (master, _):
            yield master, adapter
    finally:
        adapter.close()


@pytest.fixture(scope="module")
def controlled(tmp_path_factory) -> Iterator[Master]:
    """A controller's driver with a bit rate; QEMU's SJA1000 stands in for the chip."""
    if not all((NET / name / "device").exists() for name in ("can0", "can1")):
        pytest.skip("no controllers can0 and can1 on one wire; `make test-controllers` boots a machine that has them")
    with pair(tmp_path_factory.mktemp("robot"), "can0", "can1") as (master, _):
        yield master


pytestmark = pytest.mark.timeout(600)


@pytest.mark.parametrize(
    ("line", "kernel", "state", "text"),
    [
        ("sw096000", "ERROR-WARNING", "warning", "counts many errors"),
        ("sp128000", "ERROR-PASSIVE", "passive", "error passive"),
        ("sw000100", "ERROR-WARNING", "warning", "counts many errors"),
        ("sa000000", "ERROR-ACTIVE", "ok", ""),
        ("e1a", "ERROR-ACTIVE", "warning", "No node acknowledges"),
        ("e1o", "ERROR-ACTIVE", "warning", "overflowed"),
    ],
)
def test_the_bus_is_what_the_kernel_says(adapted, line, kernel, state, text):
    master, adapter = adapted
    adapter.report(line)
    master.until(lambda: master.bus("can0")["state"] == state and text in master.bus("can0")["text"], line)
    assert adapter.kernel_state() == kernel
    master.until_whole("frames still come and go")


def test_bus_off_stops_the_robot_and_the_link_has_to_be_set_up_again(adapted):
    master, adapter = adapted
    master.until(lambda: master.bus("can0")["state"] == "ok", "ok before")
    master.enable()
    adapter.leave_bus()
    master.until(lambda: master.bus("can0")["state"] == "bus-off", "bus-off")
    assert adapter.kernel_state() == "BUS-OFF"
    master.until(lambda: master.robot.mode == "fault", "stopped")
    master.until(lambda: not master.sample.valid["muscle_tension"].any(), "not valid")
    adapter.join_bus()
    assert master.robot.mode == "fault"
    ip("link", "set", "slc0", "down")
    ip("link", "set", "slc0", "up")
    master.until_whole("whole again")
    master.until(lambda: master.device("biceps_drive")["state"] == "ready", "the drive let go")
    assert master.robot.mode == "fault", "nothing resets itself"
    master.robot.reset()
    master.until(lambda: master.robot.mode == "off", "off")


def test_an_adapter_that_is_unplugged_and_plugged_in_again(adapted):
    master, adapter = adapted
    adapter.unplug()
    master.until(lambda: master.bus("can0")["state"] == "gone", "gone")
    master.until(lambda: not master.sample.valid["muscle_tension"].any(), "not valid")
    adapter.plug_in_again()
    master.until_whole("whole again")
    assert master.sample.values["muscle_tension"] == pytest.approx([40.0], abs=0.05)


def test_the_robot_on_controllers_of_one_megabit(controlled):
    info = facts("can0")["linkinfo"]["info_data"]
    assert info["bittiming"]["bitrate"] == 1_000_000
    assert info["restart_ms"] == 100
    assert controlled.sample.values["muscle_tension"] == pytest.approx([40.0], abs=0.05)  # N
    controlled.enable()
    controlled.target = np.array([0.32])
    controlled.until(lambda: abs(controlled.sample.values["muscle_length"][0] - 0.32) < 1e-3, "there")
    controlled.target = None
    controlled.robot.disable()
    controlled.until(lambda: controlled.robot.mode == "off", "off")
    assert facts("can0")["linkinfo"]["info_data"]["state"] == "ERROR-ACTIVE"


def test_a_controller_that_is_stopped_and_started(controlled):
    ip("link", "set", "can0", "down")
    try:
        controlled.until(lambda: controlled.bus("can0")["state"] == "gone", "gone")
        controlled.until(lambda: not controlled.sample.valid["muscle_tension"].any(), "not valid")
    finally:
        ip("link", "set", "can0", "up")
    controlled.until_whole("whole again")


def test_a_peer_that_is_stopped_and_started(controlled):
    ip("link", "set", "can1", "down")
    try:
        controlled.until(lambda: not controlled.sample.valid["muscle_tension"].any(), "not valid")
    finally:
        ip("link", "set", "can1", "up")
    controlled.until_whole("whole again")


@NEEDS_CAN_UTILS
def test_a_receive_buffer_that_overflows(controlled):
    """A real error frame: the chip's buffer is full before the interrupt is served."""
    before = controlled.bus("can0")["counters"]["error_frames"]
    flood = subprocess.Popen(["cangen", "can1", "-g", "0", "-i", "-I", "7F0", "-L", "8"])
    deadline = time.monotonic() + 20.0
    try:
        while controlled.bus("can0")["counters"]["error_frames"] == before and time.monotonic() < deadline:
            time.sleep(0.1)
    finally:
        flood.terminate()
        flood.wait(20)
    if controlled.bus("can0")["counters"]["error_frames"] == before:
        pytest.skip("interrupts are served fast enough here: no overflow within 20 s")
    controlled.until_whole("whole again")
    controlled.until(lambda: controlled.bus("can0")["state"] == "ok", "ok again")


def test_a_transmit_queue_that_is_full_says_so_at_once(controlled):
    with can.Bus(interface="socketcan", channel="can1") as bus, pytest.raises(can.CanOperationError) as caught:
        for number in range(5000):
            bus.send(can.Message(arbitration_id=0x7F0, data=number.to_bytes(8, "little"), is_extended_id=False))
    assert caught.value.error_code == 105  # ENOBUFS
