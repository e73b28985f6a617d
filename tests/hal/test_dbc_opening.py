"""Opening, stopping and inspecting nodes with a DBC file: which frames are sent, and when the driver waits."""

import math
import threading
import time

import pytest
from dbc_file import FILE, SENSOR, SERVO, settings

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.dbc import servo
from hal.drivers.dbc.sensor import DbcNode
from hal.drivers.dbc.servo import DISABLE, ENABLE, QUICK_STOP, RESET, DbcServo
from hal.drivers.dbc.settings import DbcSettings, ServoSettings
from hal.errors import ConfigError, DeviceRefused, DeviceSilent
from hal.wire.bus import Bus

NODE = 2
ANGLE, STATUS, GO = 258 + 4 * NODE, 257 + 4 * NODE, 512 + 4 * NODE
MOTION = 256 + 4 * NODE
OFF, ON, BUSY = "00 00", "01 00", "02 00"
TURN_OFF, TURN_ON = "00 00 00 00 00 00", "01 00 00 00 00 00"
IDENTITY = {"ask": {"frame": {"id": 1}}, "signals": ["Status.Fault", "Status.Mode"]}
DOG = {
    "timeout": 0.1,
    "fed_by": ["Go"],
    "configure": [{"frame": {"id": 3, "data": [7]}}],
    "expired": {"signal": "Status.Fault", "equals": 9},
}
WATCHED = {**SERVO, "watchdog": DOG, "error": {"signal": "Status.Fault"}, "reset": [{"frame": {"id": 5}}]}


class Wire:
    """The frames that a device sends, and the answers to them."""

    def __init__(self, device):
        self.device, self.sent, self.answers = device, [], {}
        device._bus.send = self._send

    def _send(self, frame):
        assert not frame.is_extended_id
        self.sent.append((frame.arbitration_id, frame.data.hex(" ").upper()))
        answer = self.answers.get(self.sent[-1]) or self.answers.get(frame.arbitration_id)
        if answer:
            self.hear(*answer)
        return True

    def hear(self, identifier, data, received=1.0):
        self.device._bus.subscriber(identifier)(bytearray.fromhex(data), received)

    def soon(self, identifier, data, after=0.03):
        """Hear a frame while the device waits."""
        threading.Timer(after, lambda: self.hear(identifier, data, time.monotonic())).start()

    def frames(self):
        sent, self.sent = self.sent, []
        return sent


@pytest.fixture
def open_wire(tmp_path):
    (tmp_path / "node.dbc").write_text(FILE)

    def make(kind, given, *quantities, node=NODE, **changes):
        bus = Bus("can0", BusConfig(interface="virtual", channel="dbc_opening"), SystemClock())
        elements = {quantity: f"{quantity}.one" for quantity in quantities or ("position",)}
        place = Place("one", elements, bus, node, tmp_path, 200.0)
        parsed = settings(ServoSettings if kind is DbcServo else DbcSettings, given, **changes)
        return Wire(kind(place, parsed))

    return make


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


def follow(wire, value, status=None):
    """The frames of one cycle with a set-point [rad]."""
    if status:
        wire.hear(STATUS, status)
    wire.device.apply([value])
    return wire.frames()


def test_a_servo_is_enabled_where_it_is_and_then_follows(open_wire):
    """Angle: -90 degrees; the set-point is held from the frame that enables it. 180 degrees are 4650h."""
    wire = open_wire(DbcServo, SERVO)
    device = wire.device
    device.is_commissioned, device.missed = True, 0
    wire.hear(STATUS, OFF)
    wire.hear(ANGLE, "FF FF DC D8")
    assert follow(wire, math.pi) == []  # nothing moves a servo that was not enabled
    device.enable()
    held = (GO, "01 FF FF DC D8 00")
    assert follow(wire, math.pi) == [held, (GO, TURN_ON)]
    wire.hear(ANGLE, "00 00 00 00")
    assert follow(wire, math.pi) == [held]
    assert follow(wire, math.pi, ON) == [held]
    assert follow(wire, math.pi) == [(GO, "01 00 00 46 50 00")]
    assert device.health().state is DeviceState.ENABLED
    assert follow(wire, math.pi, OFF)[0] == (GO, TURN_OFF)
    assert "left its enabled state by itself and is 'off'" in device.health().text
    assert follow(wire, math.pi, ON) == []  # the stop is running; no set-point is sent


def test_a_servo_that_cannot_be_enabled_says_why(open_wire):
    wire = open_wire(DbcServo, SERVO, state={**SERVO["state"], "reason": "Status.Fault"})
    device = wire.device
    device.is_commissioned, device.missed = True, 0
    wire.hear(STATUS, "00 07")
    wire.hear(ANGLE, "00 00 00 00")
    device.enable()
    for _ in range(103):
        device.apply([0.0])
    assert "cannot be enabled: after Go ON it does not report Status.Mode ON, but off" in device.health().text
    assert "its state is 'off', 7." in device.health().text
    assert not device._enable_requested
    device.reset()
    assert "cannot be enabled" not in device.health().text


@pytest.mark.parametrize(
    ("missed", "is_commissioned", "value", "is_sent"),
    [(30, True, 0.0, True), (31, True, 0.0, False), (0, False, 0.0, False), (0, True, math.nan, False)],
)
def test_set_points_that_are_not_sent(open_wire, missed, is_commissioned, value, is_sent):
    wire = open_wire(DbcServo, SERVO, cyclic=[{"frame": {"id": 6}}])
    wire.device.missed, wire.device.is_commissioned = missed, is_commissioned
    wire.device._send(value)
    assert [identifier for identifier, _ in wire.frames()] == ([GO, 6 + 4 * NODE] if is_sent else [])


@pytest.mark.parametrize("while_disabled", [False, True])
def test_what_a_servo_gets_while_it_is_disabled(open_wire, while_disabled):
    command = {**SERVO["command"], "while_disabled": while_disabled}
    wire = open_wire(DbcServo, SERVO, command=command, cyclic=[{"frame": {"id": 6}}])
    device = wire.device
    wire.hear(STATUS, OFF)
    device.missed = 0
    device.idle()
    assert wire.frames() == []  # not commissioned
    device.is_commissioned = True
    wire.hear(ANGLE, "00 00 23 28")
    device.idle()
    assert wire.frames() == [*([(GO, "01 00 00 23 28 00")] if while_disabled else []), (6 + 4 * NODE, "")]


def test_a_servo_that_somebody_else_enabled_is_disabled(open_wire):
    wire = open_wire(DbcServo, SERVO)
    device = wire.device
    device.is_commissioned, device.missed = True, 0
    wire.hear(STATUS, ON)
    device.idle()
    assert wire.frames() == [(GO, TURN_OFF)]
    device.idle()
    assert wire.frames() == []  # it is being disabled
    wire.hear(STATUS, OFF)
    device.idle()
    device.idle()
    assert wire.frames() == []


def test_a_servo_that_is_being_enabled_is_disabled_when_commands_end(open_wire):
    wire = open_wire(DbcServo, SERVO)
    device = wire.device
    device.is_commissioned, device.missed = True, 0
    wire.hear(STATUS, OFF)
    wire.hear(ANGLE, "00 00 00 00")
    device.enable()
    device.apply([0.0])
    wire.frames()
    device.idle()
    assert wire.frames() == [(GO, TURN_OFF)]
    assert device._activity.name == DISABLE


def test_a_quick_stop_is_sent_at_once_and_only_once(open_wire):
    wire = open_wire(
        DbcServo, SERVO, quick_stop=[{"frame": {"id": 7}, "until": {"signal": "Status.Mode", "equals": "OFF"}}]
    )
    device = wire.device
    wire.hear(STATUS, ON)
    device.enable()
    assert device._activity.name == ENABLE
    device.quick_stop()
    device.quick_stop()
    assert wire.frames() == [(7 + 4 * NODE, "")]
    assert (device._activity.name, device._enable_requested) == (QUICK_STOP, False)
    device.reset()
    assert device._activity.name == RESET
    plain = open_wire(DbcServo, SERVO)
    plain.device.quick_stop()
    assert plain.frames() == [(GO, TURN_OFF)]


def test_a_stop_goes_on_to_its_next_step_without_a_confirmation(open_wire):
    off = {"signal": "Status.Mode", "equals": "OFF", "within": 0.05}
    wire = open_wire(DbcServo, SERVO, quick_stop=[{"frame": {"id": 7}, "until": off}, {"frame": {"id": 8}}])
    wire.hear(STATUS, ON)
    wire.device.quick_stop()
    for _ in range(11):
        wire.device._activity.advance(wire.device._bus.send)
    assert wire.frames() == [(7 + 4 * NODE, ""), (8 + 4 * NODE, "")]
    assert wire.device._activity.failure == ""


def test_states_in_which_a_motor_has_power(open_wire):
    wire = open_wire(
        DbcServo, {**SERVO, "state": {"signal": "Status.Mode", "ready": ["OFF"], "enabled": ["ON"], "busy": ["BUSY"]}}
    )
    device = wire.device
    device.is_commissioned, device.missed = True, 0
    for status, state, has_power in (
        (OFF, DeviceState.READY, False),
        (ON, DeviceState.ENABLED, True),
        (BUSY, DeviceState.HOMING, True),
        ("03 00", DeviceState.FAULT, False),
    ):
        wire.hear(STATUS, status)
        assert device.health().state is state
        assert device._drives() is has_power
    wire.hear(STATUS, BUSY)
    assert "is in its state 'busy'" in device.health().text


def test_a_heartbeat_that_stops_is_silence_though_other_messages_come(open_wire):
    wire = open_wire(DbcNode, {**SENSOR, "heartbeat": {"message": "Status", "timeout": 0.5}})
    device = wire.device
    device.is_commissioned, device.missed = True, 0
    wire.hear(STATUS, OFF, 10.0)
    wire.hear(MOTION, "00 28 23 00 00 00 00 00", 10.5)
    assert device.health().state is DeviceState.READY
    wire.hear(MOTION, "00 28 23 00 00 00 00 00", 10.51)
    assert device.health().state is DeviceState.SILENT
    assert "has sent no 'Status' for 0.5 s" in device.health().text


@pytest.mark.parametrize(("period", "is_good"), [(0.1, True), (0.14, True), (0.16, False)])
def test_a_message_that_comes_too_seldom_is_found(open_wire, period, is_good):
    wire = open_wire(DbcNode, SENSOR)
    times = iter((5.0, 5.0 + period))

    def comes(message):
        message.received = next(times)
        return True

    wire.device._comes = comes
    check = wire.device._check_period(wire.device._error.message)
    assert (check.what, check.is_good) == ("message 'Status'", is_good)
    assert f"every {period:g} s" in check.text


def test_a_message_that_does_not_come_is_found(open_wire):
    wire = open_wire(DbcNode, {**SENSOR, "periods": {"Motion": 0.005, "Status": "cycle"}})
    wire.device._comes = lambda message: False
    (check,) = wire.device.inspect()  # a message that answers the cycle does not come by itself
    assert (check.what, check.is_good) == ("message 'Motion'", False)
    assert "every 0.005 s" in check.text


def test_a_signal_on_another_page_keeps_its_value(open_wire):
    wire = open_wire(DbcNode, SENSOR, "position", "velocity")
    wire.hear(MOTION, "00 28 23 00 00 00 00 00")
    wire.hear(MOTION, "01 64 00 00 00 00 00 00")
    sources = wire.device._sources
    assert [sources[quantity].raw for quantity in ("position", "velocity")] == [9000, 100]
    wire.hear(MOTION, "00 01 00 00 00 00 00 00")
    assert [sources[quantity].raw for quantity in ("position", "velocity")] == [1, 100]


def test_a_tare_sends_its_frames(open_wire):
    wire = open_wire(DbcNode, {**SENSOR, "tare": [{"send": "Go", "values": {"Mode": "ON"}}, {"frame": {"id": 8}}]})
    wire.device.tare()
    assert wire.frames() == [(GO, TURN_ON), (8 + 4 * NODE, "")]


def test_a_motor_is_damped_against_its_velocity(open_wire):
    """2 N m s/rad at 1.5 rad/s: -3 N m, by 0.25 N m per count above -20 N m."""
    given = {
        **SERVO,
        "periods": {"Load": "cycle", "Status": 0.05},
        "quantities": {"effort": {"signal": "Load.Force"}, "velocity": {"signal": "Load.Heat"}},
        "command": {"quantity": "effort", "send": "Push", "signal": "Torque", "while_disabled": True},
    }
    wire = open_wire(DbcServo, given, "effort", "velocity", damping=2.0)
    device = wire.device
    device.is_commissioned, device.missed = True, 0
    device._enable_requested = device._enable_succeeded = True
    wire.hear(STATUS, ON)
    for velocity, data in ((1.5, "44 00"), (-1.5, "5C 00"), (math.nan, "50 00")):
        device._values[device._slots["velocity"]] = velocity
        device.damp()
        assert wire.frames() == [(513 + 4 * NODE, data)]
    device.disable()
    wire.hear(STATUS, OFF)
    wire.frames()
    device.idle()
    assert wire.frames()[0] == (513 + 4 * NODE, "50 00")  # no effort
    undamped = open_wire(DbcServo, given, "effort", "velocity")
    undamped.device.is_commissioned, undamped.device.missed = True, 0
    undamped.device._enable_requested = undamped.device._enable_succeeded = True
    undamped.hear(STATUS, ON)
    undamped.device._values[:] = 1.0
    undamped.device.damp()
    assert undamped.frames() == [(513 + 4 * NODE, "50 00")]
    with pytest.raises(ConfigError, match="damping needs the velocity"):
        open_wire(DbcServo, given, "effort", damping=2.0)
    assert not open_wire(DbcServo, SERVO).device.can_damp


def test_bytes_and_rates_of_the_bus(open_wire):
    """Each frame counts with 8 bytes; a servo also gets its set-point and its cyclic frames."""
    sensor = settings(DbcSettings, SENSOR)
    assert DbcNode.traffic(sensor, 200.0) == ((8, pytest.approx(200.0), False), (8, pytest.approx(10.0), False))
    cyclic = settings(ServoSettings, SERVO, cyclic=[{"frame": {"id": 6}}], extended=True)
    assert DbcServo.traffic(cyclic, 100.0) == (
        (8, 100.0, True),
        (8, pytest.approx(20.0), True),
        (8, 100.0, True),
        (8, 100.0, True),
    )
