"""canopen's own CiA 402 master against the simulated drive: a reading of the standard that is not ours."""

import threading
import time

import can
import canopen
import pytest
from bench import DRIVE, SPECS, SpringWorld, config
from canopen.profiles.p402 import BaseNode402, Homing, State402

from simulators.rig import Rig

PATIENCE = 20.0
"""Real time [s]; a busy machine needs it, a quiet one a tenth of a second."""


@pytest.fixture(scope="module")
def master():
    """A drive in real time, with a master whose SYNC never stops."""
    settings = config()
    rig = Rig(settings, SpringWorld(), SPECS)
    rig.start()
    network = canopen.Network(can.Bus(interface="virtual", channel=settings.buses["can0"].channel))
    network.connect()
    node = BaseNode402(DRIVE, str(SPECS[0].eds))
    network.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = 10.0
    node.TIMEOUT_SWITCH_OP_MODE = node.TIMEOUT_SWITCH_STATE_FINAL = node.TIMEOUT_SWITCH_STATE_SINGLE = PATIENCE
    node.TIMEOUT_CHECK_TPDO = PATIENCE
    network.sync.start(0.01)
    yield node, rig
    network.sync.stop()
    network.disconnect()
    rig.stop()


@pytest.fixture
def drive(master):
    """The drive, mapped and operational, its command repeated every 10 ms."""
    node, rig = master
    node.network.nmt.send_command(0x81)
    eventually(lambda: node.nmt.state == "PRE-OPERATIONAL")
    map_pdos(node)
    node.nmt.state = "OPERATIONAL"
    node.setup_402_state_machine(read_pdos=False)
    for number in (1, 2):
        node.rpdo[number].start(0.01)
    yield node
    for number in (1, 2):
        node.rpdo[number].stop()
    rig.fault("node_reboot wire_drive")


def map_pdos(node):
    for pdos, number, names in (
        (node.rpdo, 1, ("Controlword", "Modes of operation", "Target position")),
        (node.rpdo, 2, ("Target velocity", "Target torque")),
        (node.tpdo, 1, ("Statusword", "Position actual value", "Modes of operation display")),
        (node.tpdo, 2, ("Velocity actual value", "Torque actual value")),
    ):
        pdo = pdos[number]
        pdo.read()
        pdo.clear()
        for name in names:
            pdo.add_variable(name)
        pdo.trans_type, pdo.enabled = 1, True
        pdo.cob_id = {0: 0x180, 1: 0x200}[pdos is node.rpdo] + 0x100 * (number - 1) + DRIVE
        pdo.save()


def eventually(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        threading.Event().wait(0.005)


def enable(node, mode):
    node.op_mode = mode
    node.state = "OPERATION ENABLED"
    assert node.state == "OPERATION ENABLED"
    assert node.op_mode == mode


def test_every_mode_is_offered(drive):
    modes = ("PROFILED POSITION", "HOMING", "CYCLIC SYNCHRONOUS POSITION", "CYCLIC SYNCHRONOUS VELOCITY")
    assert all(drive.is_op_mode_supported(mode) for mode in (*modes, "CYCLIC SYNCHRONOUS TORQUE"))
    assert not drive.is_op_mode_supported("PROFILED TORQUE")


def test_states_up_and_down(drive):
    enable(drive, "CYCLIC SYNCHRONOUS POSITION")
    drive.state = "SWITCHED ON"
    drive.state = "READY TO SWITCH ON"
    drive.state = "SWITCH ON DISABLED"
    assert drive.state == "SWITCH ON DISABLED"


def test_cyclic_position_is_followed(drive):
    start = drive.sdo["Position actual value"].raw
    drive.rpdo_pointers[0x607A].raw = start
    enable(drive, "CYCLIC SYNCHRONOUS POSITION")
    drive.rpdo_pointers[0x607A].raw = start + 5000
    eventually(lambda: abs(drive.tpdo_values[0x6064] - start - 5000) < 20)


def test_cyclic_velocity_turns_and_stops(drive):
    enable(drive, "CYCLIC SYNCHRONOUS VELOCITY")
    drive.rpdo_pointers[0x60FF].raw = 20_000
    eventually(lambda: abs(drive.tpdo_values[0x606C] - 20_000) < 4_000)
    drive.rpdo_pointers[0x60FF].raw = 0
    eventually(lambda: abs(drive.tpdo_values[0x606C]) < 200)


def test_a_set_point_of_profile_position_is_acknowledged_and_reached(drive):
    drive.sdo["Profile velocity"].raw = 60_000
    enable(drive, "PROFILED POSITION")
    goal = drive.tpdo_values[0x6064] - 8000
    drive.rpdo_pointers[0x607A].raw = goal
    drive.controlword = 0x001F
    eventually(lambda: drive.statusword & 1 << 12)
    drive.controlword = 0x000F
    eventually(lambda: not drive.statusword & 1 << 12)
    eventually(lambda: drive.statusword & 1 << 10 and abs(drive.tpdo_values[0x6064] - goal) < 20)


def test_homing_where_it_is(drive):
    drive.sdo["Homing method"].raw = 37
    drive.sdo["Home offset"].raw = -1500
    enable(drive, "HOMING")
    # canopen's `homing` gives up where its own command, sent every 10 ms, comes later than the next two answers.
    drive.controlword = State402.CW_OPERATION_ENABLED | Homing.CW_START
    eventually(drive.is_homed)
    eventually(lambda: abs(drive.tpdo_values[0x6064] - 1500) < 20)


def test_a_fault_is_seen_and_reset_by_an_edge(master, drive):
    _, rig = master
    enable(drive, "CYCLIC SYNCHRONOUS TORQUE")
    rig.fault("emcy wire_drive")
    eventually(lambda: drive.is_faulted())
    eventually(lambda: drive.emcy.active)
    assert drive.emcy.active[-1].code == 0x5000
    drive.controlword = 0x0000
    threading.Event().wait(0.05)
    drive.controlword = 0x0080
    eventually(lambda: drive.state == "SWITCH ON DISABLED")
    assert not drive.emcy.active
