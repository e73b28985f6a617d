"""Opening, stopping and inspecting nodes with a DBC file: which frames are sent, and when the driver waits."""

import time

import pytest
from dbc_file import SENSOR, SERVO
from dbc_wire import ANGLE, BUSY, DOG, GO, IDENTITY, MOTION, NODE, OFF, ON, STATUS, TURN_OFF, TURN_ON, WATCHED

from hal.device import DeviceState
from hal.drivers.dbc import servo
from hal.drivers.dbc.sensor import DbcNode
from hal.drivers.dbc.servo import DbcServo
from hal.errors import ConfigError, DeviceRefused, DeviceSilent


@pytest.mark.parametrize(
    ("answered", "requests", "identity"), [(1, 1, "dbc:node-5-1"), (2, 2, "dbc:node-5-1"), (3, 2, "")]
)
@pytest.mark.long
def test_an_identity_is_requested_at_most_twice(open_wire, answered, requests, identity):
    wire = open_wire(DbcNode, {**SENSOR, "identity": IDENTITY})
    count = 0

    def send(frame):
        nonlocal count
        count += 1
        if count == answered:
            wire.hear(STATUS, "01 05")

    wire.device._bus.send = send
    wire.soon(MOTION, "00 28 23 00 00 00 00 00")
    assert wire.device._identify() == identity
    assert count == requests


def test_an_answer_from_before_the_request_is_no_identity(open_wire):
    wire = open_wire(DbcNode, {**SENSOR, "identity": IDENTITY})
    wire.hear(STATUS, "01 05")
    wire.soon(MOTION, "00 28 23 00 00 00 00 00")
    assert wire.device._identify() == ""


def test_without_an_identity_nothing_is_requested(open_wire):
    wire = open_wire(DbcNode, SENSOR)
    wire.soon(MOTION, "00 28 23 00 00 00 00 00")
    assert wire.device._identify() == ""
    assert wire.frames() == []


def test_an_identity_of_whole_numbers_only(open_wire):
    with pytest.raises(ConfigError, match="no signal 'Serial'"):
        open_wire(DbcNode, {**SENSOR, "identity": {"signals": ["Status.Serial"]}})


def test_a_node_that_sends_nothing_is_silent(open_wire):
    wire = open_wire(DbcNode, SENSOR)
    started = time.monotonic()
    with pytest.raises(DeviceSilent, match=r"no 'Motion' within 0.5 s"):
        wire.device._identify()
    assert 0.5 <= time.monotonic() - started < 5.0


def test_a_node_whose_heartbeat_comes_is_known_by_it(open_wire):
    wire = open_wire(DbcNode, {**SENSOR, "heartbeat": {"message": "Status", "timeout": 0.5}})
    wire.soon(STATUS, OFF)
    assert wire.device._identify() == ""  # waited for Status, not for Motion


@pytest.mark.parametrize(("period", "longest"), [(0.005, 0.5), (0.1, 0.5), (0.3, 0.9), ("cycle", 0.5)])
def test_a_message_is_waited_for_three_of_its_periods(open_wire, period, longest):
    wire = open_wire(DbcNode, {**SENSOR, "periods": {"Motion": 0.005, "Status": period}})
    assert wire.device._longest_wait(wire.device._error.message) == pytest.approx(longest)


@pytest.mark.parametrize(("period", "patience"), [("cycle", 1), (0.005, 2), (0.012, 4), (0.1, 21), (0.14, 29)])
def test_cycles_until_a_value_is_late(open_wire, period, patience):
    """200 cycles per second; 30 of them without an answer are silence."""
    wire = open_wire(DbcNode, {**SENSOR, "periods": {"Motion": period, "Status": 0.1}})
    assert wire.device.patience == patience


def test_a_device_cannot_be_silent_before_its_next_message(open_wire):
    with pytest.raises(ConfigError, match=r"'Motion' comes every 0.145 s. Set it to 0.155 s or more"):
        open_wire(DbcNode, {**SENSOR, "periods": {"Motion": 0.145, "Status": 0.1}})


def test_a_sensor_is_sent_its_steps_and_must_then_send(open_wire):
    wire = open_wire(DbcNode, {**SENSOR, "open": [{"frame": {"id": 1, "data": [2]}}]})
    wire.soon(MOTION, "00 28 23 00 00 00 00 00", 0.05)
    wire.device._commission()
    assert wire.frames() == [(1 + 4 * NODE, "02")]
    with pytest.raises(DeviceRefused, match=r"no 'Motion', which must come every 0.005 s"):
        wire.device._commission()


def test_a_servo_that_answers_in_the_cycle_is_not_waited_for_on_opening(open_wire):
    wire = open_wire(DbcServo, SERVO)
    wire.hear(STATUS, OFF)
    wire.device._commission()
    assert wire.frames() == []


def test_a_servo_that_is_enabled_is_disabled_before_it_is_configured(open_wire):
    wire = open_wire(DbcServo, WATCHED, open=[{"frame": {"id": 4}}])
    wire.answers[GO, TURN_OFF] = (STATUS, OFF)
    wire.hear(STATUS, ON)
    wire.device._commission()
    assert wire.frames() == [(GO, TURN_OFF), (4 + 4 * NODE, ""), (3 + 4 * NODE, "07")]
    wire.hear(STATUS, OFF)
    wire.device._commission()
    assert wire.frames() == [(4 + 4 * NODE, ""), (3 + 4 * NODE, "07")]


def test_a_servo_whose_state_is_unknown_is_waited_for_on_opening(open_wire):
    wire = open_wire(DbcServo, SERVO)
    wire.answers[GO, TURN_OFF] = (STATUS, OFF)
    wire.soon(STATUS, ON)
    wire.device._commission()
    assert wire.frames() == [(GO, TURN_OFF)]


def test_a_servo_whose_state_is_known_is_not_waited_for_on_opening(open_wire):
    wire = open_wire(DbcServo, SERVO)
    wire.hear(STATUS, OFF)
    wire.device._comes = lambda message: pytest.fail("it waited")
    wire.device._commission()


def test_opening_ends_the_wish_to_move(open_wire):
    wire = open_wire(DbcServo, SERVO)
    wire.hear(STATUS, OFF)
    wire.device.enable()
    wire.device._commission()
    assert not wire.device._enable_requested
    assert wire.device._activity.is_over


def test_a_servo_that_does_not_let_go_is_not_opened(open_wire):
    wire = open_wire(DbcServo, SERVO)
    wire.hear(STATUS, ON)
    with pytest.raises(DeviceRefused, match=r"disabling: after Go OFF it does not report Status\.Mode OFF, but on"):
        wire.device._commission()


def test_a_watchdog_that_ran_out_before_opening_is_reset(open_wire, caplog):
    wire = open_wire(DbcServo, WATCHED)
    wire.hear(STATUS, "00 09")
    wire.device._commission()
    assert wire.frames() == [(3 + 4 * NODE, "07"), (5 + 4 * NODE, "")]
    assert "ran out before it was opened" in caplog.text


@pytest.mark.parametrize(
    ("was_wanted", "state", "stopped"), [(False, OFF, False), (True, OFF, True), (False, ON, True)]
)
def test_a_watchdog_that_stopped_a_motion_is_a_fault_until_it_is_reset(open_wire, was_wanted, state, stopped):
    wire = open_wire(DbcServo, WATCHED)
    device = wire.device
    device.is_commissioned, device.missed = True, 0
    wire.hear(STATUS, state)
    if was_wanted:
        device.enable()
    for _ in range(2):
        wire.hear(STATUS, "00 09")
    assert device.health().counters["watchdog_expired"] == 1
    assert bool(device._fault()) is stopped
    assert device.health().state is (DeviceState.FAULT if stopped else DeviceState.READY)
    device.disable()
    for _ in range(110):
        device.idle()
    resets = [frame for frame in wire.frames() if frame[0] == 5 + 4 * NODE]
    assert bool(resets) is not stopped
    device.reset()
    assert device._fault() == ""
    wire.hear(STATUS, OFF)
    wire.hear(STATUS, "00 09")
    assert device.health().counters["watchdog_expired"] == 2


def test_enabling_after_an_expired_watchdog_begins_with_a_reset(open_wire):
    wire = open_wire(DbcServo, WATCHED)
    device = wire.device
    device.is_commissioned, device.missed = True, 0
    wire.hear(ANGLE, "00 00 00 00")
    for status, first in ((OFF, (GO, TURN_ON)), ("00 09", (5 + 4 * NODE, ""))):
        wire.hear(STATUS, status)
        device.enable()
        device._activity.advance(device._bus.send)
        assert wire.frames()[0] == first


def test_a_watchdog_of_fewer_than_three_cycles(open_wire):
    open_wire(DbcServo, WATCHED, watchdog={**DOG, "timeout": 0.015})
    with pytest.raises(ConfigError, match="less than 3 cycles at 200 Hz"):
        open_wire(DbcServo, WATCHED, watchdog={**DOG, "timeout": 0.0149}, silent_after=0.15)


def test_what_is_known_of_a_watchdog(open_wire):
    without = open_wire(DbcServo, SERVO).device._check_watchdog()
    assert (without.is_good, "There is none" in without.text) == (False, True)
    quiet = {name: value for name, value in DOG.items() if name != "expired"}
    unproven = open_wire(DbcServo, WATCHED, watchdog=quiet).device._check_watchdog()
    assert (unproven.is_good, "cannot be checked" in unproven.text) == (True, True)
    wire = open_wire(DbcServo, WATCHED)
    assert not wire.device._check_watchdog().is_good
    wire.hear(STATUS, "00 09")
    assert wire.device._check_watchdog().is_good
    assert open_wire(DbcServo, WATCHED).device._no_watchdog == ""


@pytest.mark.parametrize(("missed", "frames"), [(30, [(GO, TURN_OFF)]), (31, [])])
def test_closing_disables_a_servo_that_is_heard(open_wire, missed, frames):
    wire = open_wire(DbcServo, SERVO)
    wire.answers[GO] = (STATUS, OFF)
    wire.hear(STATUS, ON)
    wire.device.missed = missed
    wire.device._release()
    assert wire.frames() == frames


def test_a_servo_that_starts_up_is_waited_for(open_wire):
    booting = {**SERVO, "state": {**SERVO["state"], "booting": ["BUSY"]}}
    wire = open_wire(DbcServo, booting)
    wire.hear(STATUS, BUSY)
    wire.soon(ANGLE, "00 00 00 00", 0.02)
    wire.soon(STATUS, OFF, 0.1)
    started = time.monotonic()
    wire.device._identify()
    assert 0.09 < time.monotonic() - started < 2.0


def test_a_servo_that_never_ends_starting_up_is_silent(open_wire, monkeypatch):
    monkeypatch.setattr(servo, "BOOT_TIME", 0.1)
    wire = open_wire(DbcServo, {**SERVO, "state": {**SERVO["state"], "booting": ["BUSY"]}})
    wire.hear(STATUS, BUSY)
    wire.soon(ANGLE, "00 00 00 00", 0.02)
    with pytest.raises(DeviceSilent, match=r"has been starting up for 0\.1 s"):
        wire.device._identify()


def test_a_boot_is_counted_once_and_ends_the_wish_to_move(open_wire):
    wire = open_wire(DbcServo, {**SERVO, "state": {**SERVO["state"], "booting": ["BUSY"]}})
    device = wire.device
    device.is_commissioned, device._is_closed = True, False
    wire.hear(STATUS, OFF)
    device.enable()
    for status in (BUSY, BUSY, OFF, BUSY):
        wire.hear(STATUS, status)
    assert device.health().counters["boots"] == 2
    assert not device._enable_requested
    assert device.health().state is DeviceState.OPENING
