"""A servo drive frame by frame: the controlword, mode and target of each cycle, and what its process data mean.

The joint has 4096 counts per motor turn, a gear of 50 and its zero at -0.2 rad: 32 594.93 counts per radian.
"""

import contextlib
import math

import numpy as np
import pytest
from drive_bench import HOMING, SETTINGS
from puppet import NODE, driven

from hal.device import DeviceState
from hal.drivers.cia402.drive import Cia402Drive
from hal.errors import CommandRefused, ConfigError, DeviceRefused
from hal.protocols.cia402 import State

OBJECTS = {
    "1000:0": "92 01 02 00",
    "1018:2": "02 04 00 00",
    "6061:0": "08",
    "6076:0": "C8 00 00 00",  # 0.2 N m
    "60A9:0": "00 00 00 00",
    "6502:0": "E1 03 00 00",  # profile position, homing, interpolated and cyclic synchronous modes
}
DISABLED, READY, SWITCHED_ON, ENABLED, STOPPING, FAULT, REACTION = 0x250, 0x231, 0x233, 0x237, 0x217, 0x218, 0x21F
TPDO = 0x180 + NODE


class Joint:
    """A driver that was opened with a puppet; then its frames are noted and not sent."""

    def __init__(self, device, puppet):
        self.device, self.puppet = device, puppet
        self.sent = []
        device._bus.send = self._send
        device.missed = 0

    def _send(self, frame):
        assert not frame.is_extended_id
        self.sent.append((frame.arbitration_id, frame.data.hex(" ").upper()))

    def report(self, *numbers, cob_id=TPDO, received=5.0):
        """Hear a frame of (number, bytes), low byte first."""
        data = b"".join((number & (1 << 8 * size) - 1).to_bytes(size, "little") for number, size in numbers)
        self.device.missed = 1
        self.device._bus.subscriber(cob_id)(bytearray(data), received)
        self.device.missed = 0

    def state(self, statusword, counts=1000):
        self.report((statusword, 2), (counts, 4))

    def frames(self):
        sent, self.sent = self.sent, []
        return [data for _, data in sent]

    def apply(self, value):
        self.device.apply(np.array([value]))
        return self.frames()

    def idle(self):
        self.device.idle()
        return self.frames()


@contextlib.contextmanager
def joint(mode="csp", quantities=("position",), objects=OBJECTS, **settings):
    elements = {quantity: f"joint_{quantity}.elbow" for quantity in quantities}
    with driven(Cia402Drive, elements, {**SETTINGS, "mode": mode, **settings}, objects) as (device, puppet):
        yield Joint(device, puppet)


def command(word, target, size=4):
    return (word.to_bytes(2, "little") + (target & (1 << 8 * size) - 1).to_bytes(size, "little")).hex(" ").upper()


def test_a_position_drive_is_enabled_step_by_step_and_then_follows():
    """0.8 rad is 32 595 counts; each step towards 'operation enabled' already has that target."""
    with joint() as elbow:
        assert elbow.apply(0.8) == []  # it has not reported its state
        elbow.state(DISABLED)
        assert elbow.apply(0.8) == [command(0x00, 1000)]
        elbow.device.enable()
        for statusword, word in ((DISABLED, 0x06), (READY, 0x07), (SWITCHED_ON, 0x0F), (ENABLED, 0x0F)):
            elbow.state(statusword)
            assert elbow.apply(0.8) == [command(word, 32_595)]
        assert elbow.device.health().state is DeviceState.ENABLED
        assert elbow.apply(-0.2) == [command(0x0F, 0)]
        elbow.device.disable()
        assert elbow.idle() == [command(0x06, 1000)]


@pytest.mark.parametrize(
    ("mode", "quantity", "size", "value", "target"),
    [("csv", "velocity", 4, -0.5, -16_297), ("cst", "effort", 2, 0.3, 30)],
)
def test_a_velocity_or_an_effort_is_zero_until_the_drive_is_enabled(mode, quantity, size, value, target):
    with joint(mode, (quantity,)) as elbow:
        elbow.report((SWITCHED_ON, 2), (7, size))
        elbow.device.enable()
        assert elbow.apply(value) == [command(0x0F, 0, size)]
        elbow.report((ENABLED, 2), (7, size))
        assert elbow.apply(value) == [command(0x0F, target, size)]
        elbow.report((ENABLED, 2), (7, size))
        elbow.device.disable()
        assert elbow.idle() == [command(0x07 if mode == "csv" else 0x06, 0, size)]


def test_a_profile_position_is_given_by_a_rising_edge():
    with joint("profile_position") as elbow:
        elbow.state(SWITCHED_ON, 32_595)
        elbow.device.enable()
        assert elbow.apply(0.8) == [command(0x0F, 32_595)]
        elbow.state(ENABLED, 32_595)
        assert elbow.apply(0.8) == [command(0x0F, 32_595)]  # it is there already
        assert elbow.apply(-0.2) == [command(0x3F, 0)]
        elbow.state(ENABLED | 0x1000, 32_595)
        assert elbow.apply(-0.2) == [command(0x0F, 0)]
        for _ in range(2):
            elbow.state(ENABLED)
            elbow.apply(0.8)
        for _ in range(100):
            assert elbow.device.health().text == ""
            elbow.apply(0.8)
        assert "bit 12" in elbow.device.health().text  # after 1 s at 100 Hz


def test_an_interpolated_position_needs_bit_4():
    with joint("ip") as elbow:
        elbow.state(SWITCHED_ON, 32_595)
        elbow.device.enable()
        assert elbow.apply(0.8) == [command(0x0F, 32_595)]
        elbow.state(ENABLED, 32_595)
        assert elbow.apply(0.8) == [command(0x1F, 32_595)]
        assert elbow.apply(-0.2) == [command(0x1F, 0)]
        elbow.device.disable()
        assert elbow.idle() == [command(0x06, 32_595)]


def test_a_drive_that_left_operation_enabled_stays_off():
    with joint() as elbow:
        elbow.state(ENABLED)
        elbow.device.enable()
        elbow.apply(0.0)
        elbow.state(DISABLED)
        assert elbow.apply(0.0) == [command(0x00, 1000)]
        assert "left 'operation enabled' by itself and is 'switch on disabled'" in elbow.device.health().text
        elbow.state(READY)
        assert elbow.apply(0.0) == [command(0x06, 1000)]
        elbow.device.enable()
        assert "by itself" not in elbow.device.health().text
        assert elbow.apply(0.0) == [command(0x07, 6519)]
        elbow.device.reset()
        assert elbow.device.health().text == ""


def test_nothing_is_sent_before_state_and_position_are_known():
    with joint("csp", ("position", "velocity", "effort", "following_error")) as elbow:
        assert elbow.idle() == []
        elbow.report((0, 4), (0, 4), cob_id=TPDO + 0x100)  # velocity and following error
        assert elbow.idle() == []
        elbow.report((DISABLED, 2), (1000, 4), (0, 2))
        assert elbow.idle() == [command(0x00, 1000)]
        elbow.device._counts = None
        assert elbow.idle() == []
        elbow.device._counts, elbow.device._statusword = 1000, 0
        assert elbow.idle() == [command(0x00, 1000)]
        elbow.device._lose("a test")
        assert elbow.idle() == []
        assert elbow.device._state is State.NOT_READY
        assert (elbow.device._statusword, elbow.device._counts) == (-1, None)
    with joint("csv", ("velocity",)) as elbow:
        elbow.report((DISABLED, 2), (0, 4))
        assert elbow.idle() == [command(0x00, 0)]


@pytest.mark.parametrize("direction", [1, -1])
def test_process_data_in_si(direction):
    """Status, position, effort; velocity and following error; temperature. 0.2 N m times 50 is 10 N m."""
    quantities = ("position", "effort", "velocity", "following_error", "temperature")
    temperature = {"object": "2200h:1", "scale": 0.5, "zero": -273.0}
    with joint("csp", quantities, direction=direction, temperature=temperature) as elbow:
        elbow.report((ENABLED, 2), (-32_595, 4), (250, 2), received=6.0)
        elbow.report((65_190, 4), (-3259, 4), cob_id=TPDO + 0x100, received=7.0)
        elbow.report((600, 2), cob_id=TPDO + 0x200, received=8.0)
        values = dict(zip(quantities, elbow.device.read().values, strict=True))
        assert values == {
            "position": pytest.approx(-0.2 - direction, abs=1e-4),  # rad
            "effort": pytest.approx(direction * 2.5),  # N m
            "velocity": pytest.approx(direction * 2.0, abs=1e-4),  # rad/s
            "following_error": pytest.approx(-direction * 0.1, abs=1e-4),  # rad
            "temperature": pytest.approx(27.0),  # degrees Celsius
        }
        assert elbow.device.read().received.tolist() == [6.0, 6.0, 7.0, 7.0, 8.0]


def test_a_joint_is_damped_against_its_velocity():
    """2 N m s/rad at 1 rad/s: -2 N m, 200 thousandths of 10 N m."""
    with joint("cst", ("effort", "velocity"), damping=2.0) as elbow:
        elbow.report((ENABLED, 2), (0, 2), (32_595, 4))
        elbow.device.damp()
        assert elbow.frames() == [command(0x06, 0, 2)]
        elbow.device.enable()
        elbow.device.damp()
        assert elbow.frames() == [command(0x0F, -200, 2)]
        elbow.device._velocity = math.nan
        elbow.device.damp()
        assert elbow.frames() == [command(0x0F, 0, 2)]
        assert elbow.device.can_damp
    with joint("cst", ("effort",)) as elbow:
        assert not elbow.device.can_damp
        elbow.report((ENABLED, 2), (0, 2))
        elbow.device.enable()
        elbow.device.damp()
        assert elbow.frames() == []


def test_a_quick_stop_is_sent_at_once_with_the_position():
    with joint(homing=HOMING) as elbow:
        elbow.state(ENABLED)
        elbow.report((8, 1), cob_id=TPDO + 0x100)
        elbow.device.quick_stop()
        assert elbow.frames() == ["02 00 08 E8 03 00 00"]
        assert elbow.device.health().state is DeviceState.ENABLED
        elbow.state(STOPPING)
        assert elbow.device.health().state is DeviceState.STOPPING
        assert "quick stop" in elbow.device.health().text
        assert elbow.idle() == ["02 00 08 E8 03 00 00"]
        elbow.state(READY)
        elbow.device.quick_stop()
        assert elbow.frames() == []


def test_states_in_which_the_motor_has_power():
    with joint() as elbow:
        for statusword, has_power, state in (
            (0x200, False, DeviceState.READY),
            (DISABLED, False, DeviceState.READY),
            (READY, False, DeviceState.READY),
            (SWITCHED_ON, False, DeviceState.READY),
            (ENABLED, True, DeviceState.ENABLED),
            (STOPPING, True, DeviceState.STOPPING),
            (REACTION, True, DeviceState.FAULT),
            (FAULT, False, DeviceState.FAULT),
        ):
            elbow.state(statusword)
            assert elbow.device._drives() is has_power
            assert elbow.device.health().state is state


@pytest.mark.parametrize(
    ("statusword", "text"), [(0x031, "own panel"), (0x2B1, "bit 7"), (0x231, ""), (0x0B1, "own panel")]
)
def test_bits_that_an_operator_must_see(statusword, text):
    with joint() as elbow:
        assert elbow.device.health().text == ""  # nothing is known yet
        elbow.state(statusword)
        found = elbow.device.health().text
        assert text in found
        assert bool(found) is bool(text)


def test_homing_begins_from_ready_and_is_counted():
    with joint(homing={**HOMING, "timeout": 0.5}) as elbow:
        drive = elbow.device
        elbow.state(ENABLED)
        with pytest.raises(CommandRefused, match="is enabled, not ready"):
            drive.home()
        elbow.state(READY)
        drive.home()
        assert drive.health().state is DeviceState.HOMING
        assert "entering the homing mode" in drive.health().text
        assert elbow.idle() == ["06 00 06 E8 03 00 00"]
        elbow.report((6, 1), cob_id=TPDO + 0x100)
        assert elbow.idle() == ["07 00 06 E8 03 00 00"]
        elbow.state(ENABLED)
        assert [elbow.idle()[0][:5] for _ in range(6)] == ["0F 00", *["1F 00"] * 5]
        elbow.state(0x1637)
        assert elbow.idle()[0][:8] == "06 00 06"
        elbow.state(READY)
        elbow.report((8, 1), cob_id=TPDO + 0x100)
        assert elbow.idle()[0][:8] == "06 00 08"
        assert drive.health().counters["homed"] == 1
        assert drive.health().text == ""
        assert drive.health().state is DeviceState.READY


def test_a_fault_is_reset_by_rising_edges_until_it_is_gone_and_not_again():
    with joint() as elbow:
        elbow.state(FAULT)
        elbow.device.reset()
        words = [elbow.idle()[0][:5] for _ in range(9)]
        assert words == ["80 00", *["00 00"] * 3] * 2 + ["80 00"]
        elbow.state(DISABLED)
        elbow.idle()
        elbow.state(FAULT)  # a new fault is for an operator
        assert {elbow.idle()[0][:5] for _ in range(9)} == {"00 00"}


def test_a_fault_that_stays_is_reset_for_two_seconds():
    with joint() as elbow:
        elbow.state(FAULT)
        elbow.device.reset()
        assert [elbow.idle()[0][:5] for _ in range(300)].count("80 00") == 50


def test_homing_that_takes_too_long_or_is_stopped_says_so():
    with joint(homing={**HOMING, "timeout": 0.5}) as elbow:
        drive = elbow.device
        elbow.state(READY)
        elbow.report((8, 1), cob_id=TPDO + 0x100)
        drive.home()
        for _ in range(50):  # 0.5 s at 100 Hz
            elbow.idle()
            assert drive.health().state is DeviceState.HOMING
        elbow.idle()
        assert drive.health().state is DeviceState.READY
        assert "homing took longer than allowed" in drive.health().text
        drive.home()
        assert drive.health().text != ""
        drive.disable()
        elbow.idle()
        assert "homing was stopped" in drive.health().text
        assert drive.health().counters["homed"] == 0


def test_a_drive_without_the_setting_is_not_homed():
    with joint() as elbow:
        elbow.state(READY)
        with pytest.raises(CommandRefused, match="no setting `homing`"):
            elbow.device.home()


@pytest.mark.parametrize(
    ("changes", "settings", "text"),
    [
        ({"6502:0": "61 03 00 00"}, {}, "does not have the mode cyclic synchronous position"),
        ({"6502:0": "C1 03 00 00"}, {"homing": HOMING}, "does not have the mode homing"),
        ({"60A9:0": "00 03 B5 05"}, {}, None),
        ({"60A9:0": "00 03 41 00"}, {}, r"unknown unit 00410300h \(60A9h\)"),
    ],
)
def test_modes_and_units_that_the_drive_reports(changes, settings, text):
    if text is None:
        with joint(objects=OBJECTS | changes, quantities=("position", "velocity"), **settings) as elbow:
            assert elbow.device._units.velocity == pytest.approx(1e5 / 32_594.93, rel=1e-5)
        with joint(objects=OBJECTS | changes, velocity_unit="rpm", quantities=("position", "velocity")) as elbow:
            assert elbow.device._units.velocity == pytest.approx(2 * math.pi / 60 / 50)
        return
    with pytest.raises(DeviceRefused, match=text), joint(objects=OBJECTS | changes, **settings):
        raise AssertionError


def test_the_rated_torque_comes_from_the_robot_file_or_the_drive():
    quantities = ("position", "effort")
    with joint(quantities=quantities) as elbow:
        assert elbow.device._units.effort == pytest.approx(0.01)
    with joint(quantities=quantities, rated_torque=0.4) as elbow:
        assert elbow.device._units.effort == pytest.approx(0.02)
    with joint(objects=OBJECTS | {"6076:0": "00 00 00 00"}) as elbow:
        assert math.isnan(elbow.device._units.effort)
    with (
        pytest.raises(DeviceRefused, match="rated torque of 0"),
        joint(quantities=quantities, objects=OBJECTS | {"6076:0": "00 00 00 00"}),
    ):
        raise AssertionError


@pytest.mark.parametrize(("actual", "is_good"), [("08", True), ("07", False), ("09", False), ("FF", False)])
def test_inspection_compares_the_mode(actual, is_good):
    with joint() as elbow:
        del elbow.device._bus.send  # SDO needs the bus
        elbow.puppet.objects["6061:0"] = bytes.fromhex(actual)
        (check,) = (check for check in elbow.device.inspect() if check.what == "mode")
        assert check.is_good is is_good
        assert ("Open it again" in check.text) is not is_good


def test_a_layout_of_the_robot_file_puts_each_number_in_its_place():
    pdo = {
        "receives": [{"number": 1, "objects": ["607Ah int32", "6060h int8", "6040h uint16"], "transmission": 1}],
        "sends": [{"number": 1, "objects": ["6041h uint16", "6064h int32"], "transmission": 1}],
    }
    with joint(pdo=pdo) as elbow:
        elbow.state(READY)
        assert elbow.idle() == ["E8 03 00 00 08 06 00"]
        assert elbow.sent == []
        elbow.device.quick_stop()
        elbow.device._state = State.OPERATION_ENABLED
        elbow.device.quick_stop()
        assert elbow.sent == [(0x205, "E8 03 00 00 08 02 00")]
    pdo["receives"][0]["objects"] = ["607Ah int32", "6040h uint16", "6071h int16"]
    with pytest.raises(ConfigError, match="would be sent as 0"), joint(pdo=pdo):
        raise AssertionError
