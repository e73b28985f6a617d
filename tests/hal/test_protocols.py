"""Golden frames, written out from the standards' tables by hand: they pin both ends of the wire independently."""

import pytest

from hal.protocols import cia301, cia402
from hal.protocols.cia402 import State


def test_predefined_connection_set():
    node = 5
    assert cia301.EMERGENCY + node == 0x085
    assert cia301.TPDO1 + node == 0x185
    assert cia301.RPDO1 + node == 0x205
    assert cia301.SDO_ANSWER + node == 0x585
    assert cia301.SDO_REQUEST + node == 0x605
    assert cia301.HEARTBEAT + node == 0x705


@pytest.mark.parametrize(
    ("command", "frame"),
    [("START", "01 05"), ("STOP", "02 05"), ("PRE_OPERATIONAL", "80 05"), ("RESET_NODE", "81 05")],
)
def test_nmt_commands(command, frame):
    assert cia301.nmt_command(cia301.NmtCommand[command], 5) == bytes.fromhex(frame)


@pytest.mark.parametrize(
    ("frame", "state"),
    [("00", 0x00), ("04", 0x04), ("05", 0x05), ("7F", 0x7F), ("85", 0x05), ("", None), ("05 00", None)],
)
def test_heartbeat(frame, state):
    assert cia301.nmt_state(bytes.fromhex(frame)) == state


def test_emergency():
    heartbeat_lost = cia301.emergency(bytes.fromhex("30 81 11 01 02 03 04 05"))
    assert heartbeat_lost == cia301.EmergencyMessage(0x8130, 0x11, bytes((1, 2, 3, 4, 5)))
    assert cia301.describe_emergency(0x8130) == "communication: life guard or heartbeat error (8130h)"
    assert cia301.describe_emergency(0x4310) == "temperature (4310h)"
    assert cia301.describe_emergency(0x0700) == "unknown family (0700h)"
    assert cia301.emergency(bytes(7)) is None


def test_pdo_mapping_entries():
    assert [item.entry for item in (cia402.CONTROLWORD, cia402.TARGET_POSITION)] == [0x60400010, 0x607A0020]
    assert [item.entry for item in (cia402.STATUSWORD, cia402.TORQUE)] == [0x60410010, 0x60770010]


def test_consumer_heartbeat_entry():
    assert cia301.consumer_heartbeat(127, 0.15) == 0x007F0096


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (0x0000, State.NOT_READY),
        (0x0250, State.SWITCH_ON_DISABLED),
        (0x0231, State.READY_TO_SWITCH_ON),
        (0x0233, State.SWITCHED_ON),
        (0x0237, State.OPERATION_ENABLED),
        (0x1637, State.OPERATION_ENABLED),
        (0x0217, State.QUICK_STOP_ACTIVE),
        (0x021F, State.FAULT_REACTION),
        (0x023F, State.FAULT_REACTION),
        (0x0218, State.FAULT),
        (0x0238, State.FAULT),
        (0x02B7, State.OPERATION_ENABLED),
    ],
)
def test_statuswords(statusword, state):
    assert cia402.state(statusword) is state


def test_every_statusword_has_a_state_and_only_one_is_enabled():
    enabled = [word for word in range(1 << 16) if cia402.state(word) is State.OPERATION_ENABLED]
    assert all(word & 0x6F == 0x27 for word in enabled)
    assert len(enabled) == 1 << 10


def test_the_way_to_enabled_and_back():
    words = [cia402.towards_enabled(s) for s in (State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON, State.SWITCHED_ON)]
    assert words == [0x06, 0x07, 0x0F]
    assert cia402.towards_enabled(State.OPERATION_ENABLED) == 0x0F
    assert cia402.towards_disabled(State.OPERATION_ENABLED) == 0x06
    assert cia402.towards_disabled(State.QUICK_STOP_ACTIVE) == 0x00


@pytest.mark.parametrize("state", [State.FAULT, State.FAULT_REACTION, State.NOT_READY])
def test_no_controlword_enables_out_of_a_fault(state):
    assert cia402.towards_enabled(state) & 0x0F == 0
    assert cia402.towards_enabled(state) & cia402.FAULT_RESET == 0


def test_no_controlword_towards_disabled_enables():
    assert all(cia402.towards_disabled(state) & 0x0F != 0x0F for state in State)
