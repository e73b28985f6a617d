"""Homing and the handshake of profile position cycle by cycle (CiA 402-2), and controlwords of a drive over time."""

import pytest
from drive_bench import JointBench

from hal.drivers.cia402.modes import HomingRun, SetPointHandshake
from hal.protocols.cia402 import OperationMode, State

ON, OFF = State.OPERATION_ENABLED, State.READY_TO_SWITCH_ON
OWN, HOMING = OperationMode.CYCLIC_SYNCHRONOUS_POSITION, OperationMode.HOMING
ENABLED, START = 0x0F, 0x1F
FOUND, PART, ERROR = 0x1437, 0x1037, 0x2437
"""Statuswords: homing attained and target reached, only attained, and a homing error."""


def searching(longest=100):
    """A run that has begun to search, after three cycles."""
    run = HomingRun(OWN, longest)
    assert run.step(OFF, 0x0231, OWN) == (0x06, HOMING)
    assert run.step(OFF, 0x0231, HOMING) == (0x07, HOMING)
    assert run.step(ON, 0x0237, HOMING) == (ENABLED, HOMING)
    return run


def test_a_homing_from_its_beginning_to_its_end():
    run = searching()
    for _ in range(5):  # bits of the time before count for nothing
        assert run.step(ON, FOUND, HOMING) == (START, HOMING)
    assert run.step(ON, PART, HOMING) == (START, HOMING)
    assert run.step(ON, 0x0437, HOMING) == (START, HOMING)  # target reached alone: interrupted, or not started
    assert run.step(ON, FOUND, HOMING) == (0x06, HOMING)
    assert (run.problem, run.is_over) == ("", False)
    assert run.step(State.QUICK_STOP_ACTIVE, FOUND, HOMING) == (0x00, HOMING)
    assert run.step(OFF, 0x0231, HOMING) == (0x06, OWN)
    assert not run.is_over
    assert run.step(OFF, 0x0231, OWN) == (0x06, OWN)
    assert (run.problem, run.is_over) == ("", True)


def test_a_homing_error():
    run = searching()
    for _ in range(5):
        assert run.step(ON, ERROR, HOMING) == (START, HOMING)
    assert run.step(ON, ERROR, HOMING) == (0x06, HOMING)
    assert "error" in run.problem


def test_a_drive_that_drops_out_of_homing():
    run = searching()
    assert run.step(State.FAULT, 0x0218, HOMING) == (0x00, OWN)
    assert "'fault'" in run.problem


def test_homing_takes_no_longer_than_allowed():
    run = searching(longest=10)
    for _ in range(7):
        assert run.step(ON, 0x0237, HOMING) == (START, HOMING)
    assert run.step(ON, 0x0237, HOMING) == (0x06, HOMING)
    assert run.problem
    for _ in range(9):  # the drive does not take its own mode again
        run.step(OFF, 0x0231, HOMING)
    assert not run.is_over
    run.step(OFF, 0x0231, HOMING)
    run.step(OFF, 0x0231, HOMING)
    assert run.is_over


def test_the_first_reason_to_give_up_stays():
    run = searching()
    run.give_up("was stopped")
    run.give_up("again")
    assert run.problem == "was stopped"


def test_cycles_without_an_acknowledgement_are_counted():
    handshake = SetPointHandshake()
    assert handshake.waited == 0
    handshake.start(5)
    assert handshake.step(6, 0x0237) == (0x30, 6)
    for waited in range(1, 4):
        assert handshake.step(7, 0x0237) == (0x30, 6)
        assert handshake.waited == waited
    handshake.step(7, 0x1237)
    assert handshake.waited == 0
    handshake.step(7, 0x1237)
    assert handshake.waited == 1
    handshake.start(5)
    assert handshake.waited == 0


@pytest.fixture
def joint():
    bench = JointBench("csp", quantities=("position",)).open()
    bench.cycle(3)
    yield bench
    bench.close()


def words(bench, state, cycles):
    """The controlwords of a drive that stays in a state."""
    sent = []
    drive = bench.drive
    send, drive._send = drive._send, lambda word, target, mode: sent.append(word)
    drive._state = state
    for _ in range(cycles):
        drive.idle()
    drive._send = send
    return sent


def test_a_fault_is_reset_by_a_rising_edge_in_every_fourth_of_200_cycles(joint):
    joint.drive.reset()
    sent = words(joint, State.FAULT, 204)
    assert sent[:200] == [0x80, 0, 0, 0] * 50
    assert sent[200:] == [0] * 4
    joint.drive.reset()
    assert words(joint, State.FAULT_REACTION, 2) == [0, 0]
    assert words(joint, State.FAULT, 3) == [0, 0, 0x80]
    assert words(joint, State.SWITCH_ON_DISABLED, 1) == [0x00]
    assert words(joint, State.FAULT, 8) == [0] * 8  # one reset does not clear the next fault
    joint.drive.reset()
    assert words(joint, State.NOT_READY, 4) == [0] * 4  # it was lost, and its fault is not known yet
    assert 0x80 in words(joint, State.FAULT, 4)


def test_a_quick_stop_lasts_at_most_08_s_and_then_the_power_is_taken_off(joint):
    joint.drive._state = State.OPERATION_ENABLED
    joint.drive.quick_stop()
    assert words(joint, State.QUICK_STOP_ACTIVE, 161) == [0x02] * 159 + [0x00, 0x00]


def test_a_quick_stop_ends_when_the_drive_has_stopped(joint):
    joint.drive._state = State.OPERATION_ENABLED
    joint.drive.quick_stop()
    assert words(joint, State.QUICK_STOP_ACTIVE, 3) == [0x02] * 3
    assert words(joint, State.SWITCH_ON_DISABLED, 1) == [0x00]
    assert words(joint, State.OPERATION_ENABLED, 1) == [0x06]  # not a quick stop: that has ended


def test_a_drive_that_is_off_needs_no_quick_stop(joint):
    joint.drive.quick_stop()
    assert words(joint, State.OPERATION_ENABLED, 1) == [0x06]


def test_a_velocity_drive_slows_down_for_at_most_08_s():
    bench = JointBench("csv").open()
    try:
        bench.enable()
        bench.drive.disable()
        assert words(bench, State.OPERATION_ENABLED, 162) == [0x07] * 159 + [0x06] * 3
        bench.drive.enable()
        bench.drive.disable()
        assert words(bench, State.OPERATION_ENABLED, 2) == [0x07] * 2
        assert words(bench, State.SWITCHED_ON, 1) == [0x06]
        assert words(bench, State.OPERATION_ENABLED, 1) == [0x06]
        bench.drive.disable()  # it was not wanted: nothing to slow down from
        assert words(bench, State.OPERATION_ENABLED, 1) == [0x06]
    finally:
        bench.close()
