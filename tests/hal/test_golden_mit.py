"""Frames of MIT mode worked out by hand from the documented scaling, independently of both ends of the wire."""

import math

import pytest

from hal.protocols import mit
from hal.protocols.mit import Answer, Command, Layout, Ranges, Register, Special
from hal.protocols.mit_motors import MOTORS

AK80_9 = MOTORS["AK80-9"].ranges
"""12.5 rad, 50 rad/s, 18 N m, 500 N m/rad, 5 N m s/rad."""
DM4310 = MOTORS["DM4310"].ranges
"""12.5 rad, 30 rad/s, 10 N m."""


def hexed(data):
    return data.hex(" ").upper()


def packed(command, ranges=AK80_9):
    return hexed(mit.COMMAND_LAYOUT.pack(mit.pack(command, ranges)))


@pytest.mark.parametrize("name", MOTORS)
def test_zero_is_seven_ff(name):
    # (0 + r) * (2^n - 1) / 2r is 32767.5 and 2047.5; cut off or half a count down it is 7FFFh and 7FFh.
    zero = packed(Command(0.0, 0.0, 0.0, 0.0, 0.0), MOTORS[name].ranges)
    assert zero == "7F FF 7F F0 00 00 07 FF"


def test_special_frames():
    assert hexed(mit.special(Special.ENTER)) == "FF FF FF FF FF FF FF FC"
    assert hexed(mit.special(Special.EXIT)) == "FF FF FF FF FF FF FF FD"
    assert hexed(mit.special(Special.ZERO)) == "FF FF FF FF FF FF FF FE"
    assert hexed(mit.special(Special.CLEAR)) == "FF FF FF FF FF FF FF FB"


def test_command_in_the_middle_of_everything():
    # position 1 rad: 13.5 * 65535 / 25 = 35388.9 -> 35389 = 8A3Dh; velocity -10: 40 * 4095 / 100 = 1638 = 666h
    # kp 100: 100 * 4095 / 500 = 819 = 333h; kd 1: 4095 / 5 = 819 = 333h; torque 9: 27 * 4095 / 36 = 3071.25 -> BFFh
    asked = Command(1.0, -10.0, 100.0, 1.0, 9.0)
    assert packed(asked) == "8A 3D 66 63 33 33 3B FF"


def test_ends_of_every_field():
    top = Command(12.5, 50.0, 500.0, 5.0, 18.0)
    assert packed(top) == "FF FF FF FF FF FF FF FF"
    bottom = Command(-12.5, -50.0, 0.0, 0.0, -18.0)
    assert packed(bottom) == "00 00 00 00 00 00 00 00"


def test_what_does_not_fit_is_clipped_and_never_wraps():
    wild = Command(1e9, -1e9, 1e9, -1e9, 1e9)
    assert packed(wild) == "FF FF 00 0F FF 00 0F FF"


def test_command_read_back():
    read = mit.parse_command(bytes.fromhex("8A3D66633333 3BFF".replace(" ", "")), AK80_9)
    assert read == Command(
        pytest.approx(1.0, abs=25 / 65535),
        pytest.approx(-10.0),
        pytest.approx(100.0),
        pytest.approx(1.0),
        pytest.approx(9.0, abs=36 / 4095),
    )
    assert mit.parse_command(bytes.fromhex("FFFFFFFFFFFFFFFD"), AK80_9) is Special.EXIT
    assert mit.parse_command(bytes.fromhex("FFFFFFFFFFFFFF"), AK80_9) is None


def test_a_value_that_was_read_is_sent_back_as_the_same_counts():
    for end, top in ((12.5, 65535), (12.566, 65535), (45.0, 4095), (18.0, 4095), (200.0, 4095)):
        for counts in range(0, top + 1, 7):
            value = counts * 2 * end / top - end
            assert mit.to_counts(value, -end, end, top) == counts


def test_answer_of_t_motor_with_temperature():
    # id 2; position 9000h = 36864: 36864 * 25 / 65535 - 12.5 = 1.5627; velocity 900h: 2304 * 100 / 4095 - 50 = 6.2637
    # torque 700h: 1792 * 36 / 4095 - 18 = -2.2462; temperature 46h = 70 - 40 = 30; error 2
    answer = mit.parse_answer(bytes.fromhex("0290009007004602"), Layout.T_MOTOR, AK80_9)
    assert answer == Answer(
        2,
        2,
        pytest.approx(1.5627, abs=1e-4),
        pytest.approx(6.2637, abs=1e-4),
        pytest.approx(-2.2462, abs=1e-4),
        30.0,
        pytest.approx(math.nan, nan_ok=True),
    )
    assert "overcurrent" in mit.describe_error(answer.state, Layout.T_MOTOR)


def test_answer_of_older_t_motor_and_of_mini_cheetah():
    short = bytes.fromhex("01 7FFF 7FF 7FF".replace(" ", ""))
    answer = mit.parse_answer(short, Layout.T_MOTOR, AK80_9)
    assert (answer.node, answer.state) == (1, 0)
    assert answer.position == pytest.approx(-12.5 / 65535)  # half a count below zero: the firmware cuts off
    assert math.isnan(answer.temperature)
    assert mit.parse_answer(short + b"\x80", Layout.MINI_CHEETAH, AK80_9).position == answer.position


def test_answer_of_damiao():
    # D[0]: error Dh in the upper, id 5 in the lower four bits; driver 20h = 32, rotor 2Ah = 42 degrees
    answer = mit.parse_answer(bytes.fromhex("D5 4000 400 C00 20 2A".replace(" ", "")), Layout.DAMIAO, DM4310)
    assert (answer.node, answer.state) == (5, 0xD)
    assert answer.position == pytest.approx(16384 * 25 / 65535 - 12.5)
    assert answer.velocity == pytest.approx(1024 * 60 / 4095 - 30)
    assert answer.effort == pytest.approx(3072 * 20 / 4095 - 10)
    assert (answer.temperature, answer.temperature_driver) == (42.0, 32.0)
    assert "CAN timeout" in mit.describe_error(answer.state, Layout.DAMIAO)


@pytest.mark.parametrize("position", ["0000", "FFFF"])
def test_a_value_at_the_end_of_its_range_is_not_known(position):
    answer = mit.parse_answer(bytes.fromhex(f"11 {position} 000 FFF 19 19".replace(" ", "")), Layout.DAMIAO, DM4310)
    assert math.isnan(answer.position)
    assert math.isnan(answer.velocity)
    assert math.isnan(answer.effort)


@pytest.mark.parametrize("layout", Layout)
def test_answers_of_a_wrong_length(layout):
    for size in set(range(9)) - set(mit.SIZES[layout]):
        assert mit.parse_answer(bytes(size), layout, DM4310) is None


def test_registers():
    # 0.15 s in steps of 50 us is 3000 = 0BB8h, least significant byte first
    assert hexed(mit.read_register(5, Register.TIMEOUT)) == "05 00 33 09 00 00 00 00"
    assert hexed(mit.write_register(5, Register.TIMEOUT, 3000)) == "05 00 55 09 B8 0B 00 00"
    assert hexed(mit.write_register(0x123, Register.MODE, 1)) == "23 01 55 0A 01 00 00 00"
    found = mit.parse_register(bytes.fromhex("0500330900000000"), 5)
    assert (found.register, found.integer) == (Register.TIMEOUT, 0)
    ranged = mit.parse_register(bytes.fromhex("0500331500004841"), 5)
    assert (ranged.register, ranged.real) == (Register.POSITION_RANGE, 12.5)


def test_an_ordinary_answer_is_no_register():
    assert mit.parse_register(bytes.fromhex("0292557FF7FE1C1B"), 2) is None  # D[2] is 55h by chance
    assert mit.parse_register(bytes.fromhex("1500331500004841"), 5) is None  # an enabled drive's
    assert mit.parse_register(bytes.fromhex("050033090000"), 5) is None


def test_ranges_of_one_motor():
    assert Ranges(12.5, 50.0, 18.0, 500.0, 5.0) == AK80_9


def test_errors_and_special_values_as_the_makers_document_them():
    t_motor = ["too hot", "overcurrent", "overvoltage", "undervoltage", "encoder fault", "unbalanced phase currents"]
    for code, text in enumerate(t_motor, 1):
        assert text in mit.describe_error(code, Layout.T_MOTOR)
    damiao = {0x8: "overvoltage", 0x9: "undervoltage", 0xA: "overcurrent", 0xB: "driver", 0xC: "rotor", 0xD: "CAN"}
    for code, text in {**damiao, 0xE: "overload"}.items():
        assert text in mit.describe_error(code, Layout.DAMIAO)
        assert f"error {code:X}h" in mit.describe_error(code, Layout.DAMIAO)
    for code, layout in ((7, Layout.T_MOTOR), (0, Layout.T_MOTOR), (7, Layout.DAMIAO), (0xF, Layout.DAMIAO)):
        assert "not documented" in mit.describe_error(code, layout)
    assert {code.name: code.value for code in Register} == {
        "MASTER_ID": 7,
        "NODE_ID": 8,
        "TIMEOUT": 9,
        "MODE": 10,
        "SERIAL": 15,
        "POSITION_RANGE": 21,
        "VELOCITY_RANGE": 22,
        "EFFORT_RANGE": 23,
    }
    assert (mit.REGISTERS, mit.NODES, mit.MIT_MODE, mit.TIMEOUT_UNIT) == (0x7FF, 0x7FF, 1, 50e-6)
    assert (mit.ENABLED, mit.DISABLED, mit.T_MOTOR_COLDEST) == (1, 0, -40)
    assert mit.SIZES == {Layout.MINI_CHEETAH: (6, 7), Layout.T_MOTOR: (6, 8), Layout.DAMIAO: (8,)}


@pytest.mark.parametrize(
    ("name", "layout", "position", "velocity", "effort"),
    [
        ("mini-cheetah", "mini_cheetah", 12.5, 65, 18),
        ("AK10-9", "t_motor", 12.5, 50, 65),
        ("AK60-6", "t_motor", 12.5, 45, 15),
        ("AK70-10", "t_motor", 12.5, 50, 25),
        ("AK80-6", "t_motor", 12.5, 76, 12),
        ("AK80-9", "t_motor", 12.5, 50, 18),
        ("AK80-64", "t_motor", 12.5, 8, 144),
        ("DM3507", "damiao", 12.566, 50, 5),
        ("DM4310", "damiao", 12.5, 30, 10),
        ("DM4310-48V", "damiao", 12.5, 50, 10),
        ("DM4310P", "damiao", 12.5, 50, 10),
        ("DM4340", "damiao", 12.5, 10, 28),
        ("DM4340-48V", "damiao", 12.5, 10, 28),
        ("DM6006", "damiao", 12.5, 45, 20),
        ("DM8006", "damiao", 12.5, 45, 40),
        ("DM8009", "damiao", 12.5, 45, 54),
        ("DM10010L", "damiao", 12.5, 25, 200),
        ("DM10010", "damiao", 12.5, 20, 200),
        ("DMH3510", "damiao", 12.5, 280, 1),
        ("DMH6215", "damiao", 12.5, 45, 10),
        ("DMG6220", "damiao", 12.5, 45, 10),
    ],
)
def test_ranges_as_the_makers_print_them(name, layout, position, velocity, effort):
    assert MOTORS[name].layout == layout
    assert MOTORS[name].ranges == Ranges(position, velocity, effort, 500.0, 5.0)


def test_counts_of_an_answer_and_its_ends():
    assert mit.counts(bytes.fromhex("01 8001 802 403 00 00".replace(" ", ""))) == (0x8001, 0x802, 0x403)
    lowest = mit.parse_answer(bytes.fromhex("11 0001 001 001 00 00".replace(" ", "")), Layout.DAMIAO, DM4310)
    assert (lowest.position, lowest.velocity, lowest.effort) == (
        pytest.approx(25 / 65535 - 12.5),
        pytest.approx(60 / 4095 - 30),
        pytest.approx(20 / 4095 - 10),
    )
    highest = mit.parse_answer(bytes.fromhex("11 FFFE FFE FFE 00 00".replace(" ", "")), Layout.DAMIAO, DM4310)
    assert highest.position == pytest.approx(12.5 - 25 / 65535)
    assert highest.effort == pytest.approx(10 - 20 / 4095)


@pytest.mark.parametrize(
    ("value", "counts"),
    [(-1.0, 0), (-0.5, 1), (-0.499, 2), (0.0, 2), (0.001, 3), (0.5, 3), (1.0, 4), (2.0, 4), (-9, 0)],
)
def test_the_nearest_counts_and_half_a_count_is_rounded_down(value, counts):
    """-1..1 in counts 0..4 is half a unit per count, here a quarter off: -0.75 and -0.25 lie between two counts."""
    assert mit.to_counts(value, -1.0, 1.0, 4) == counts - (value in (-0.499, 0.001))
    assert [mit.to_counts(half, -1.0, 1.0, 4) for half in (-0.75, -0.25, 0.25, 0.75)] == [0, 1, 2, 3]


@pytest.mark.parametrize(("data", "is_register"), [("05 00 33", True), ("05 00 55", True), ("05 00 34", False)])
def test_answers_to_register_requests(data, is_register):
    frame = bytes.fromhex(data) + bytes.fromhex("0A 01 02 03 04")
    found = mit.parse_register(frame, 5)
    assert (found is not None) == is_register
    if found:
        assert (found.node, found.register, found.data, found.integer) == (5, 10, bytes((1, 2, 3, 4)), 0x04030201)
    assert mit.parse_register(frame, 0x105) is None
    far = bytes.fromhex("05 01") + frame[2:]
    assert (mit.parse_register(far, 0x105) is not None) == is_register


@pytest.mark.parametrize("last", ["FB", "FC", "FD", "FE"])
def test_a_command_that_ends_like_a_special_frame_is_a_command(last):
    for first in ("8A 3D 66 63 33 33 3B", "FF FF FF FF FF FF FE"):
        assert isinstance(mit.parse_command(bytes.fromhex(f"{first} {last}"), AK80_9), Command)
    assert mit.parse_command(bytes.fromhex(f"FF FF FF FF FF FF FF {last}"), AK80_9) == Special(int(last, 16))
    assert isinstance(mit.parse_command(bytes.fromhex("FF FF FF FF FF FF FF FF"), AK80_9), Command)
