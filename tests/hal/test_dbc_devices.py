"""What the DBC drivers make of files of all kinds: pages, byte orders, answers in the cycle, steps and raw frames."""

import math

import can
import pytest
from dbc_bench import axis, dbc_bench, opened
from dbc_file import FILE, SENSOR, SERVO, settings

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.device import DeviceState
from hal.drivers.can_device import Place
from hal.drivers.dbc.sensor import DbcNode
from hal.drivers.dbc.sequence import Address, Inbox, SequenceRun, compile_steps
from hal.drivers.dbc.servo import DISABLE, QUICK_STOP, DbcServo
from hal.drivers.dbc.settings import DbcSettings, ServoSettings, StepConfig
from hal.errors import CommandRefused, ConfigError
from hal.protocols import dbc
from hal.wire.bus import Bus


@pytest.fixture
def place(tmp_path):
    (tmp_path / "node.dbc").write_text(FILE)
    bus = Bus("can0", BusConfig(interface="virtual", channel="dbc_devices"), SystemClock())

    def where(*quantities, node=2):
        return Place("one", {quantity: f"{quantity}.one" for quantity in quantities}, bus, node, tmp_path, 200.0)

    return where


@pytest.fixture
def inbox(tmp_path):
    (tmp_path / "node.dbc").write_text(FILE)
    return Inbox(dbc.load(tmp_path / "node.dbc"))


def test_pages_of_a_message_are_read_one_by_one(place):
    device = DbcNode(place("position", "velocity"), settings(DbcSettings, SENSOR))
    device.is_commissioned = True
    hear = device._bus.subscriber(256 + 8)
    device._bus.subscriber(257 + 8)(bytearray.fromhex("01 00"), 1.0)
    hear(bytearray.fromhex("00 28 23 00 00 00 00 00"), 1.0)  # 90 degrees
    hear(bytearray.fromhex("01 64 00 00 00 00 00 00"), 2.0)  # 10 rpm
    reading = device.read()
    assert reading.values == pytest.approx([math.pi / 2, math.pi / 3])  # rad, rad/s
    assert reading.received.tolist() == [1.0, 2.0]
    hear(bytearray.fromhex("07 64 00 00 00 00 00 00"), 3.0)
    assert device.health().counters["malformed"] == 1
    assert reading.received.tolist() == [1.0, 2.0]


def test_an_error_in_another_message_makes_values_doubtful(place):
    device = DbcNode(place("position"), settings(DbcSettings, SENSOR))
    device.is_commissioned = True
    hear, tell = device._bus.subscriber(256 + 8), device._bus.subscriber(257 + 8)
    tell(bytearray.fromhex("01 00"), 1.0)
    hear(bytearray.fromhex("00 28 23 00 00 00 00 00"), 1.0)
    assert device.read().values[0] == pytest.approx(math.pi / 2)
    tell(bytearray.fromhex("01 05"), 1.1)
    hear(bytearray.fromhex("00 28 23 00 00 00 00 00"), 1.1)
    assert math.isnan(device.read().values[0])
    assert "reports 5 (Status.Fault)" in device.health().text


def test_gain_zero_and_direction_are_those_of_the_main_quantity(place):
    """Force: raw 100 is 40 of the file's units, 0.2 * 40 + 3 = 11, 4 * 11 - 7 = 37; heat: raw 65 is 25."""
    cell = {
        "node_offset": 4,
        "periods": {"Load": 0.01},
        "quantities": {
            "force": {"signal": "Load.Force", "scale": 0.2, "offset": 3.0},
            "temperature": {"signal": "Load.Heat", "scale": 2.0, "offset": -1.0},
        },
    }
    device = DbcNode(place("force", "temperature"), settings(DbcSettings, cell, gain=4.0, zero=-7.0))
    device.is_commissioned = True
    device._bus.subscriber(259 + 8)(bytearray.fromhex("64 00 41 00"), 1.0)
    assert device.read().values == pytest.approx([37.0, 2 * 25.0 - 1.0])
    encoder = {**SENSOR, "quantities": {"velocity": {"signal": "Motion.Speed", "scale": 2.0, "offset": 3.0}}}
    encoder["quantities"]["position"] = {"signal": "Motion.Angle", "scale": 0.5, "offset": 5.0}
    device = DbcNode(place("velocity", "position", node=3), settings(DbcSettings, encoder, direction=-1, zero=100.0))
    device.is_commissioned = True
    hear = device._bus.subscriber(256 + 12)
    device._bus.subscriber(257 + 12)(bytearray.fromhex("00 00"), 1.0)
    hear(bytearray.fromhex("00 28 23 00 00 00 00 00"), 1.0)  # 90
    hear(bytearray.fromhex("01 64 00 00 00 00 00 00"), 1.0)  # 10
    assert device.read().values == pytest.approx([-(2.0 * 10.0 + 3.0), 100.0 - (0.5 * 90.0 + 5.0)])


@pytest.mark.parametrize(
    ("command", "value", "data"),
    [
        # measured: effort = 0.2 * (raw / 2 - 10) + 3; commanded in the same way: raw = 4 * (torque + 20)
        ({}, 11.0, "F0 00"),  # torque 40: raw 240
        ({}, 3.0, "50 00"),  # torque 0: raw 80
        ({"scale": -2.0}, 11.0, "40 00"),  # (11 - 3) / -2 = -4: raw 64
        ({"offset": 1.0}, 11.0, "18 01"),  # torque 50: raw 280
        ({"scale": 0.5, "offset": -1.0}, 0.0, "58 00"),  # torque 2: raw 88
    ],
)
def test_set_points_with_a_scale_and_an_offset_of_their_own(place, command, value, data):
    servo = {
        **SERVO,
        "periods": {"Load": 0.01, "Status": 0.05},
        "quantities": {"effort": {"signal": "Load.Force", "scale": 0.2, "offset": 3.0}},
        "command": {"quantity": "effort", "send": "Push", "signal": "Torque", **command},
    }
    device = DbcServo(place("effort"), settings(ServoSettings, servo))
    device._writer.write((value - device._offset) / device._scale)
    assert device._frame.data == bytes.fromhex(data)


def test_a_servo_that_answers_in_the_cycle_is_waited_for(place):
    device = DbcServo(place("position"), settings(ServoSettings, SERVO))
    bus = device._bus
    device.is_commissioned = True
    bus.begin()
    assert device in bus._waiting
    bus.subscriber(258 + 8)(bytearray.fromhex("FF FF DC D8"), 1.0)  # -90 degrees, highest byte first
    assert device not in bus._waiting
    assert device.read().values[0] == pytest.approx(-math.pi / 2)  # rad
    free = DbcServo(place("position", node=3), settings(ServoSettings, SERVO, periods={"Angle": 0.01, "Status": 0.05}))
    free.is_commissioned = True
    bus.begin()
    assert (device in bus._waiting, free in bus._waiting) == (True, False)


def test_set_points_with_the_highest_byte_first_and_within_the_files_range(place):
    device = DbcServo(place("position"), settings(ServoSettings, SERVO, direction=-1, zero=0.5))
    for value, data in (
        (0.5 - math.pi / 2, "01 00 00 23 28 00"),  # 90 degrees
        (0.5 + math.pi, "01 FF FF B9 B0 00"),
        (-1e9, "01 00 0D BB A0 00"),  # 9000 degrees
    ):
        device._writer.write((value - device._offset) / device._scale)
        assert device._frame.data == bytes.fromhex(data)
    assert device._frame.arbitration_id == 512 + 8


def test_states_that_the_robot_file_does_not_name_are_faults(place):
    device = DbcServo(place("position"), settings(ServoSettings, SERVO))
    device.is_commissioned, device.missed = True, 0
    tell = device._bus.subscriber(257 + 8)
    for data, state in (("00 00", DeviceState.READY), ("01 00", DeviceState.ENABLED), ("02 00", DeviceState.FAULT)):
        tell(bytearray.fromhex(data), 1.0)
        assert device.health().state is state
    assert "its state 'busy' (Status.Mode)" in device.health().text
    tell(bytearray.fromhex("00 00"), 1.0)
    assert "goes on with its last set-point when the host dies" in device.health().text


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"state": {"signal": "Status.Mode", "ready": ["OFF"], "enabled": ["OFF"]}}, "has two meanings"),
        ({"command": {**SERVO["command"], "signal": "Angl"}}, "no signal 'Angl'. Did you mean Angle"),
        ({"command": {**SERVO["command"], "quantity": "effort"}}, "'effort' is not measured"),
        ({"cyclic": [SERVO["enable"][0]]}, "remove its `until`"),
        ({"enable": [{"frame": {"id": 1}, "send": "Go"}]}, "either `send` or `frame`"),
        ({"enable": [{"frame": {"id": 1, "data": [256]}}]}, "enable.0.frame.data"),
        ({"enable": [{"until": {"signal": "Go.Mode", "equals": "AN"}}]}, "no value 'AN'"),
        ({"tare": [SERVO["enable"][0]]}, "cannot wait"),
        ({"quantities": {"position": {"signal": "Angle.Angle", "scale": 0}}}, "a factor must not be 0"),
        ({"periods": {"Status": 0.05}}, "does not have the period of 'Angle'"),
        ({"periods": {"Angle": 0.01}}, "does not have the period of 'Status'"),
    ],
)
def test_settings_that_do_not_fit_are_refused(place, changes, sentence):
    with pytest.raises((ConfigError, ValueError), match=sentence):
        DbcServo(place("position"), settings(ServoSettings, SERVO, **changes))


def test_a_cell_without_a_tare_says_so(place):
    with pytest.raises(CommandRefused, match="cannot be tared"):
        DbcNode(place("position"), settings(DbcSettings, SENSOR)).tare()


def steps(inbox, *given):
    address = Address(2, 4, None)
    compiled = compile_steps([StepConfig.model_validate(one) for one in given], inbox, address, 200.0)
    inbox.seal()
    return compiled


def hear(inbox, *raws):
    inbox.messages["Status"].raws = tuple(raws)


def test_raw_frames(inbox):
    found = steps(
        inbox,
        {"frame": {"id": 0x10, "data": [1, 2]}},
        {"frame": {"id": 0x7DF, "broadcast": True, "remote": True}},
        {"frame": {"id": 0x12345, "data": [3]}},
    )
    answer = [
        (s.frame.arbitration_id, bytes(s.frame.data), s.frame.is_remote_frame, s.frame.is_extended_id) for s in found
    ]
    assert answer == [
        (0x18, b"\1\2", False, False),
        (0x7DF, b"", True, False),
        (0x1234D, b"\3", False, True),
    ]


def test_steps_go_on_when_they_are_confirmed_by_something_new(inbox):
    on = {"signal": "Status.Mode", "equals": "ON", "within": 1.0}
    run = SequenceRun("test", steps(inbox, {"send": "Go", "until": on}, {"frame": {"id": 1}}), 200.0)
    sent: list[can.Message] = []
    hear(inbox, 1)
    for _ in range(10):
        run.advance(sent.append)
    assert len(sent) == 1  # it said so before it was asked
    assert not run.has_sent_last
    hear(inbox, 1)
    run.advance(sent.append)
    run.advance(sent.append)
    assert [frame.arbitration_id for frame in sent] == [512 + 8, 1 + 8]
    assert run.is_over
    assert not run.failure


def test_a_step_that_is_not_confirmed_is_sent_again_and_then_given_up(inbox):
    on = {"signal": "Status.Mode", "one_of": ["ON", "BUSY"], "within": 0.5}
    compiled = steps(inbox, {"send": "Go", "values": {"Mode": "ON"}, "until": on}, {"frame": {"id": 1}})
    for goes_on, frames in ((False, 3), (True, 4)):
        run = SequenceRun("test", compiled, 200.0, goes_on)
        sent: list[can.Message] = []
        for _ in range(110):
            hear(inbox, 0)
            run.advance(sent.append)
        assert len(sent) == frames
        assert run.is_over
    failed = SequenceRun("test", compiled, 200.0)
    while not failed.is_over:
        failed.advance(lambda frame: True)
    assert failed.failure == "after Go ON it does not report Status.Mode ON or BUSY, but off"


def test_a_step_that_is_not_needed_is_left_out(inbox):
    off = {"signal": "Status.Mode", "equals": "OFF"}
    run = SequenceRun("test", steps(inbox, {"send": "Go", "unless": off}), 200.0)
    sent: list[can.Message] = []
    hear(inbox, 0)
    run.advance(sent.append)
    assert run.is_over
    assert not sent


def test_the_set_point_stays_from_the_moment_the_loop_is_asked_to_close():
    """The state is told up to a heartbeat later; meanwhile the drive must hold, not follow what it is pushed to."""
    bench = opened(dbc_bench())
    try:
        bench.robot.enable()
        node = axis(bench)
        while node.condition != "closed loop control":
            bench.cycle()
        asked = node.input[3]
        bench.world.break_part("set:joint_position.elbow:0.62")
        while bench.device("elbow_axis")["state"] != "enabled":
            assert node.input[3] == asked
            bench.cycle()
    finally:
        bench.close()


def test_an_axis_that_refuses_is_told_with_its_reason():
    bench = opened(dbc_bench())
    try:
        node = axis(bench)
        node._request = lambda data: setattr(node, "result", 14)
        node.routes_changed()
        bench.robot.enable()
        bench.until(lambda: "cannot be enabled" in bench.device("elbow_axis")["text"], "refused", 400)
        assert "its state is 'idle', not calibrated" in bench.device("elbow_axis")["text"]
    finally:
        bench.close()


def sent_in(run, cycles, report=None):
    """The cycles in which a run sends a frame, from 1; `report` is called before each."""
    sent = []
    for cycle in range(1, cycles + 1):
        if report is not None:
            report(cycle)
        run.advance(lambda frame, cycle=cycle: sent.append(cycle) or True)
    return sent


def test_a_step_is_sent_again_every_02_s_and_fails_after_its_time(inbox):
    on = {"signal": "Status.Mode", "equals": "ON", "within": 0.5}
    run = SequenceRun("test", steps(inbox, {"send": "Go", "until": on}), 200.0)
    assert not run.has_sent_last
    assert sent_in(run, 1) == [1]
    assert run.has_sent_last
    assert sent_in(run, 99) == [40, 80]
    assert not run.is_over
    assert sent_in(run, 1) == []
    assert run.is_over
    assert "nothing" in run.failure


def test_a_step_ends_in_the_cycle_of_its_confirmation(inbox):
    on = {"signal": "Status.Mode", "equals": "ON", "within": 0.5}
    run = SequenceRun("test", steps(inbox, {"send": "Go", "until": on}, {"send": "Go"}, {"until": on}), 200.0)
    assert sent_in(run, 5, lambda cycle: hear(inbox, int(cycle >= 3))) == [1, 4]
    assert not run.is_over
    assert run.failure == ""
    hear(inbox, 0)
    assert sent_in(run, 1) == []
    hear(inbox, 1)
    assert sent_in(run, 1) == []
    assert run.is_over


@pytest.mark.parametrize(
    ("condition", "raw", "is_met"),
    [
        ({"equals": "BUSY"}, 2, True),
        ({"equals": "BUSY"}, 1, False),
        ({"one_of": ["OFF", 3]}, 0, True),
        ({"one_of": ["OFF", 3]}, 3, True),
        ({"one_of": ["OFF", 3]}, 1, False),
        ({"below": 2.5}, 2, True),
        ({"below": 2.0}, 2, False),
    ],
)
def test_conditions(inbox, condition, raw, is_met):
    found = inbox.condition(StepConfig.model_validate({"until": {"signal": "Status.Mode", **condition}}).until)
    inbox.seal()
    assert not found.is_met()
    hear(inbox, raw)
    assert found.is_met() is is_met
    assert not found.is_met(found.newest)
    assert found.is_met(()) is is_met


@pytest.mark.parametrize(
    ("force", "is_met"), [(-9.0, True), (-11.0, True), (9.5, True), (10.5, False), (-10.5, False), (10.0, False)]
)
def test_a_condition_on_a_magnitude_is_in_the_unit_of_the_file(inbox, force, is_met):
    condition = {"signal": "Load.Force", "below": 10.0}
    found = inbox.condition(StepConfig.model_validate({"until": condition}).until)
    inbox.seal()
    inbox.messages["Load"].raws = ((force + 10.0) / 0.5,)  # the file's factor is 0.5, its offset -10
    assert found.is_met() is (is_met and abs(force) < 10.0)


@pytest.mark.parametrize(
    ("node", "base", "extended", "identifier"),
    [
        (2, 256, None, (264, False)),
        (2, 256, True, (264, True)),
        (447, 256, None, (2044, False)),
        (447, 259, None, (0x7FF, False)),
        (448, 256, None, None),
        (448, 256, True, (2048, True)),
    ],
)
def test_identifiers_of_11_and_29_bits(node, base, extended, identifier):
    address = Address(node, 4, extended)
    if identifier is None:
        with pytest.raises(ConfigError, match="node id is 447"):
            address.identifier(base, False, "message 'Go'")
    else:
        assert address.identifier(base, False, "message 'Go'") == identifier


@pytest.mark.parametrize(("period", "is_fault"), [(0.0049, False), (0.0031, False), (0.0029, True), (0.0025, True)])
def test_sending_faster_than_stated_is_a_fault(place, period, is_fault):
    """50 messages in less than 0.6 of the time that 50 periods take, twice in a row: two devices under one node id."""
    device = DbcNode(place("position"), settings(DbcSettings, SENSOR))
    device.is_commissioned = True
    hear = device._bus.subscriber(256 + 8)
    device._bus.subscriber(257 + 8)(bytearray.fromhex("00 00"), 0.0)
    for number in range(149):
        hear(bytearray.fromhex("00 28 23 00 00 00 00 00"), 10.0 + number * period)
    assert device._fault() == ""
    hear(bytearray.fromhex("00 28 23 00 00 00 00 00"), 10.0 + 149 * period)
    assert bool(device._fault()) is is_fault


@pytest.mark.parametrize(("fault", "is_good"), [(4, False), (5, True), (6, False)])
def test_only_the_good_value_of_the_error_signal_is_good(place, fault, is_good):
    error = {"signal": "Status.Fault", "good": 5}
    device = DbcNode(place("position"), settings(DbcSettings, SENSOR, error=error))
    assert device._error_text() == ""
    device.is_commissioned = True
    device._bus.subscriber(257 + 8)(bytearray([0, fault]), 1.0)
    device._bus.subscriber(256 + 8)(bytearray.fromhex("00 28 23 00 00 00 00 00"), 1.0)
    assert math.isnan(device.read().values[0]) is not is_good
    assert (device._error_text() == "") is is_good


def test_a_value_in_words_is_no_bit_field_unless_the_robot_file_says_so(inbox):
    fault = inbox.signal("Status.Fault")
    inbox.seal()
    inbox.messages["Status"].raws = (6.0,)
    assert fault.describe() == "6"
    assert fault.describe(is_bits=True) == "bit 1, bit 2"


def test_disable_does_not_break_off_a_quick_stop(place):
    device = DbcServo(place("position"), settings(ServoSettings, SERVO))
    device.disable()
    assert device._activity.name == DISABLE
    device._begin(QUICK_STOP)
    device.disable()
    assert device._activity.name == QUICK_STOP
    for _ in range(101):
        device._activity.advance(lambda frame: True)
    assert device._activity.is_over
    device.disable()
    assert device._activity.name == DISABLE
