"""Servos with a DBC file frame by frame: enabling, set-points, stops, and messages that come late."""

import math

import pytest
from dbc_file import FILE, SENSOR, SERVO, settings
from dbc_wire import ANGLE, BUSY, GO, MOTION, NODE, OFF, ON, STATUS, TURN_OFF, TURN_ON

from hal.device import DeviceState
from hal.drivers.dbc.sensor import DbcNode
from hal.drivers.dbc.servo import DISABLE, ENABLE, QUICK_STOP, RESET, DbcServo
from hal.drivers.dbc.settings import DbcSettings, ServoSettings
from hal.errors import ConfigError
from hal.protocols.can_frames import Frames


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


def test_bytes_and_rates_of_the_bus(tmp_path):
    """A servo also gets its set-point, its cyclic messages and frames."""
    (tmp_path / "node.dbc").write_text(FILE)
    sensor = settings(DbcSettings, SENSOR)
    assert DbcNode.traffic_of(sensor, 200.0, (), tmp_path) == (
        Frames(8, pytest.approx(200.0)),
        Frames(2, pytest.approx(10.0)),
    )
    steps = [{"frame": {"id": 6, "data": [1, 2, 3]}}, {"frame": {"id": 7, "broadcast": True}}, {"send": "Push"}]
    cyclic = settings(ServoSettings, SERVO, cyclic=steps, extended=True)
    assert DbcServo.traffic_of(cyclic, 100.0, (), tmp_path) == (
        Frames(4, 100.0, True),
        Frames(2, pytest.approx(20.0), True),
        Frames(6, 100.0, True),
        Frames(2, 100.0, True),
        Frames(3, 100.0, True),
        Frames(0, 100.0, False),
    )
