"""Frames of sensors, written out from the standards and makers' manuals by hand.

CiA 404 (6130h, 7130h, 9130h, 7100h, 9100h, 6125h, 6131h, 6132h, 6150h), CiA 401 (6401h to 6403h, 6423h), CiA 406 (6000h
to 6004h, 6030h, 6031h, 6501h to 6505h), CiA 303-2 (units). Two conversations are those that the manual of the Baumer
StrainLink prints.
"""

import math

import pytest
from puppet import NODE, driven, report

from hal.drivers.canopen.analog import Cia401Input, Cia404Cell
from hal.drivers.canopen.cia406 import Cia406Encoder
from hal.errors import ConfigError, DeviceRefused, WrongDevice
from hal.protocols import analog, cia406

FORCE = {"force": "muscle_tension.biceps"}
CELL = {"1000:0": "94 01 02 00", "1018:2": "04 04 00 00", "6131:1": "00 00 21 00", "6132:1": "02"}
INPUTS = {"1000:0": "91 01 04 00", "1018:2": "01 04 00 00"}
ENCODER = {
    "1000:0": "96 01 01 00",
    "1018:2": "06 04 00 00",
    "6000:0": "00 00",
    "6001:0": "10 0E 00 00",
    "6002:0": "00 E1 00 00",
    "6031:3": "01 00",
    "6031:4": "01 00",
    "6501:0": "00 10 00 00",
    "6502:0": "10 00",
}


def cell(objects=CELL, elements=FORCE, **settings):
    return driven(Cia404Cell, elements, {"eds": "eds/load_cell.eds", **settings}, objects)


def inputs(elements=FORCE, **settings):
    return driven(Cia401Input, elements, {"eds": "eds/analog_input.eds", **settings}, INPUTS)


def encoder(objects=ENCODER, elements=None, **settings):
    elements = elements or {"position": "joint_position.elbow"}
    return driven(Cia406Encoder, elements, {"eds": "eds/joint_encoder.eds", **settings}, objects)


@pytest.mark.parametrize(
    ("code", "quantity", "scale"),
    [
        (0x00210000, "force", 1.0),
        (0x03210000, "force", 1e3),
        (0xFD210000, "force", 1e-3),
        (0x00020000, "force", 9.80665),
        (0x00220000, "pressure", 1.0),
        (0x06220000, "pressure", 1e6),
    ],
)
def test_units(code, quantity, scale):
    unit = analog.unit(code)
    assert unit.quantity == quantity
    assert unit.scale == pytest.approx(scale)


@pytest.mark.parametrize("code", [0x00000000, 0x00010000, 0x00210300, 0x00210001, 0x7F210000, 0x002D0000, 0xFA010100])
def test_what_is_no_unit_of_force_or_pressure(code):
    assert analog.unit(code) is None


@pytest.mark.parametrize(
    ("preset", "entry"),
    [
        ("float32", "20 01 30 61"),
        ("int16", "10 01 30 71"),
        ("int32", "20 01 30 91"),
        ("counts16", "10 01 00 71"),
        ("counts32", "20 01 00 91"),
        ("strain_link", "10 01 30 71"),
    ],
)
def test_a_cell_maps_its_value_and_its_status(preset, entry):
    with cell(preset=preset, gain=1.0) as (_, puppet):
        start = puppet.requests.index("2F 00 1A 00 00 00 00 00")
        mapping = [request for request in puppet.requests[start:] if request[:2] != "40"]
        assert mapping[:5] == [
            "2F 00 1A 00 00 00 00 00",  # no objects while the mapping changes
            f"23 00 1A 01 {entry}",
            "23 00 1A 02 08 01 50 61",
            "2F 00 1A 00 02 00 00 00",
            "23 00 18 01 85 01 00 00",  # TPDO1 of node 5, valid
        ]
        assert "2F 00 18 02 01 00 00 00" in puppet.requests  # at every SYNC


@pytest.mark.parametrize(
    ("preset", "data", "newtons"),
    [
        ("int32", "D2 04 00 00 00", 12.34),
        ("int32", "2E FB FF FF 00", -12.34),
        ("int16", "18 FC 00", -10.0),
        ("float32", "00 00 48 41 00", 12.5),
        ("float32", "00 00 C0 7F 00", math.nan),
        ("float32", "00 00 80 7F 00", math.nan),
        ("int32", "D2 04 00 00 01", math.nan),
        ("int32", "D2 04 00 00 02", math.nan),
        ("int32", "D2 04 00 00 04", math.nan),
        ("int32", "D2 04 00 00 80", math.nan),
        ("int16", "FF 7F 00", math.nan),
        ("int16", "00 80 00", math.nan),
    ],
)
@pytest.mark.long
def test_what_a_cell_tells(preset, data, newtons):
    with cell(preset=preset) as (device, puppet):
        assert report(device, puppet, data) == [pytest.approx(newtons, nan_ok=True)]


def test_gain_zero_and_direction_of_a_cell():
    with cell(gain=-2.0, zero=1.5) as (device, puppet):
        assert report(device, puppet, "E8 03 00 00 00") == [pytest.approx(1.5 - 2.0 * 10.0)]


def test_kilonewton_and_kilogram_become_newton():
    with cell({**CELL, "6131:1": "00 00 21 03", "6132:1": "05"}) as (device, puppet):
        assert report(device, puppet, "39 30 00 00 00") == [pytest.approx(123.45)]
    with cell({**CELL, "6131:1": "00 00 02 00", "6132:1": "01"}) as (device, puppet):
        assert report(device, puppet, "64 00 00 00 00") == [pytest.approx(98.0665)]


def test_four_channels_have_a_status_each():
    elements = {f"force_{n}": f"muscle_tension.m{n}" for n in (1, 2, 4)}
    objects = CELL | {f"6131:{n}": "00 00 21 00" for n in (2, 4)} | {f"6132:{n}": "02" for n in (2, 4)}
    with cell(objects, elements, channels=[1, 2, 4], preset="int16") as (device, puppet):
        assert "23 00 1A 05 10 04 30 71" not in puppet.requests, "the third pair does not fit into eight bytes"
        assert "23 01 1A 01 10 04 30 71" in puppet.requests
        report(device, puppet, "64 00 00 C8 00 02")
        values = report(device, puppet, "2C 01 00", cob_id=0x280 + NODE)
        assert values == [pytest.approx(1.0), pytest.approx(math.nan, nan_ok=True), pytest.approx(3.0)]


def test_a_tare_is_the_signature_zero():
    with cell({**CELL, "6124:1": "00 00 C0 BF"}) as (device, puppet):
        device.tare()
        device.long_request()
        assert "23 25 61 01 7A 65 72 6F" in puppet.requests
        assert device.health().counters["tared"] == 1


def test_the_strain_link_of_its_manual():
    """Manual V3.05: 6131h:1 is FA010100h (um/m), 6132h:1 is 2, and it is tared by 6125h."""
    told_by_manual = {**CELL, "6131:1": "00 01 01 FA", "6132:1": "02"}
    with pytest.raises(DeviceRefused, match=r"FA010100h.*no force"), cell(told_by_manual, preset="int16"):
        raise AssertionError("strain was taken for a force")
    with cell(told_by_manual, preset="strain_link", gain=0.4) as (device, puppet):
        assert report(device, puppet, "10 27 00") == [pytest.approx(0.4 * 100.0)]  # 100 um/m


def test_torque_and_pressure_need_their_own_units():
    torque = {"torque": "joint_torque.elbow"}
    with cell(elements=torque, measures="torque", unit="mN m", digits=0) as (device, puppet):
        assert report(device, puppet, "D2 04 00 00 00") == [pytest.approx(1.234)]
    pressure = {"pressure": "air.bellows"}
    with cell({**CELL, "6131:1": "00 00 22 03"}, pressure, measures="pressure") as (device, puppet):
        assert report(device, puppet, "D2 04 00 00 00") == [pytest.approx(12_340.0)]
    with pytest.raises(DeviceRefused, match="no torque"), cell(elements=torque, measures="torque"):
        raise AssertionError("newton was taken for newton metre")
    with pytest.raises(ConfigError, match="'N' is no unit of torque"), cell(measures="torque", unit="N"):
        raise AssertionError


@pytest.mark.parametrize(
    ("preset", "entry", "data", "number"),
    [
        ("int16", "10 01 01 64", "00 40", 16384),
        ("int16", "10 01 01 64", "00 C0", -16384),
        ("int32", "20 01 02 64", "00 00 00 40", 2**30),
        ("float32", "20 01 03 64", "00 00 A0 40", 5.0),
    ],
)
def test_analogue_inputs(preset, entry, data, number):
    with inputs(preset=preset, gain=0.25, zero=-1.0) as (device, puppet):
        assert f"23 00 1A 01 {entry}" in puppet.requests
        assert "2F 23 64 00 01 00 00 00" in puppet.requests  # global interrupt enable
        assert report(device, puppet, data) == [pytest.approx(0.25 * number - 1.0)]


@pytest.mark.parametrize(("resolution", "data"), [(None, "FF 7F"), (None, "00 80"), (12, "F0 7F"), (14, "FC 7F")])
def test_an_input_at_its_end_is_an_overload(resolution, data):
    with inputs(gain=1.0, resolution=resolution) as (device, puppet):
        assert report(device, puppet, data) == [pytest.approx(math.nan, nan_ok=True)]
        assert "overload" in device.health().text


def test_an_input_of_fewer_bits_just_below_its_end():
    with inputs(gain=1.0, resolution=12) as (device, puppet):
        assert report(device, puppet, "E0 7F") == [2046 << 4]


def test_a_makers_status_object_for_all_channels():
    elements = {"force_1": "muscle_tension.biceps", "force_2": "muscle_tension.triceps"}
    settings = {"channels": [1, 2], "gain": [1.0, -1.0], "status": "2120h:0 uint16", "bad_status": 0x24}
    with inputs(elements, **settings) as (device, puppet):
        assert "23 00 1A 01 10 00 20 21" in puppet.requests
        assert report(device, puppet, "01 00 0A 00 14 00") == [10.0, -20.0]
        assert all(math.isnan(value) for value in report(device, puppet, "04 00 0A 00 14 00"))


def test_counts_need_a_gain():
    with pytest.raises(ConfigError, match="Give `gain`"), inputs():
        raise AssertionError
    with pytest.raises(ConfigError, match="Give `gain`"), cell(preset="counts32"):
        raise AssertionError


TURN = 2.0 * math.pi


@pytest.mark.parametrize(
    ("settings", "data", "angle"),
    [
        ({}, "00 08 00 00 00 00 00 00", TURN / 2),
        ({"direction": -1, "zero": 1.0}, "00 04 00 00 00 00 00 00", 1.0 - TURN / 4),
        ({"around": 0.0}, "FF FF 00 00 00 00 00 00", -TURN / 4096),
        ({"around": 0.0}, "00 7F 00 00 00 00 00 00", 7.9375 * TURN),
        ({"around": 0.0, "direction": -1}, "FF FF 00 00 00 00 00 00", TURN / 4096),
        ({"around": 20.0 * TURN}, "00 00 00 00 00 00 00 00", 16 * TURN),
        ({"counts_per_turn": 40960.0}, "00 50 00 00 00 00 00 00", TURN / 2),
        ({}, "00 00 01 00 00 00 00 00", math.nan),
        ({}, "00 08 00 00 01 00 00 00", math.nan),
        ({}, "00 08 00 00 00 10 00 00", math.nan),
        ({}, "00 08 00 00 00 00 10 00", TURN / 2),
    ],
)
@pytest.mark.long
def test_positions(settings, data, angle):
    """4096 counts per turn, 16 turns; position, alarms, warnings."""
    with encoder(**settings) as (device, puppet):
        assert report(device, puppet, data) == [pytest.approx(angle, nan_ok=True)]


def test_scaling_that_is_on_counts():
    with encoder({**ENCODER, "6000:0": "04 00"}, around=0.0) as (device, puppet):
        assert report(device, puppet, "08 07 00 00 00 00 00 00") == [pytest.approx(TURN / 2)]  # 1800 of 3600
        assert report(device, puppet, "FF E0 00 00 00 00 00 00") == [pytest.approx(-TURN / 3600)]  # of 16 * 3600


def test_an_encoder_maps_speed_where_it_is_wanted():
    elements = {"position": "joint_position.elbow", "velocity": "joint_velocity.elbow"}
    with encoder(elements=elements, direction=-1) as (device, puppet):
        mapped = [request[12:] for request in puppet.requests if request.startswith("23 00 1A")]
        assert mapped == ["20 00 04 60", "10 00 03 65", "10 01 30 60"]
        values = report(device, puppet, "00 08 00 00 00 00 00 04")
        assert values == [pytest.approx(-TURN / 2), pytest.approx(-TURN / 4)]  # 1024 counts/s
        assert math.isnan(report(device, puppet, "00 08 00 00 00 00 FF 7F")[1]), "the end of the range is no speed"
        assert not any("03 60" in request[3:8] for request in puppet.requests), "the preset is never touched"


def test_a_speed_divider_of_0_divides_by_nothing():
    elements = {"position": "joint_position.elbow", "velocity": "joint_velocity.elbow"}
    with encoder({**ENCODER, "6031:3": "00 00", "6031:4": "00 00"}, elements) as (device, puppet):
        assert report(device, puppet, "00 08 00 00 00 00 00 04")[1] == pytest.approx(TURN / 4)


@pytest.mark.parametrize(("data", "counts"), [("FE 7F", 32766), ("FF 7F", None), ("02 80", -32766), ("01 80", None)])
def test_a_speed_at_the_end_of_its_range_is_not_known(data, counts):
    """INTEGER16: 32767 and below -32766 may be a speed that does not fit."""
    elements = {"position": "joint_position.elbow", "velocity": "joint_velocity.elbow"}
    with encoder(elements=elements) as (device, puppet):
        velocity = report(device, puppet, f"00 08 00 00 00 00 {data}")[1]
        expected = math.nan if counts is None else counts / 4096 * TURN
        assert velocity == pytest.approx(expected, nan_ok=True)


def test_speed_in_turns_per_minute():
    elements = {"position": "joint_position.elbow", "velocity": "joint_velocity.elbow"}
    objects = {**ENCODER, "6031:3": "3C 00", "6031:4": "00 10"}  # times 60, divided by 4096
    with encoder(objects, elements) as (device, puppet):
        assert report(device, puppet, "00 08 00 00 00 00 1E 00")[1] == pytest.approx(30 / 60 * TURN)


def test_a_warning_is_told_and_the_position_is_good():
    with encoder() as (device, puppet):
        report(device, puppet, "00 08 00 00 00 00 10 00")
        device.missed = 0
        assert "battery charge too low" in device.health().text


def test_another_profile_is_another_device():
    with pytest.raises(WrongDevice, match="profile 406, not 404"), cell({**CELL, "1000:0": "96 01 01 00"}):
        raise AssertionError


def test_bits_in_words():
    assert analog.describe_status(0) == ""
    assert analog.describe_status(0x03) == "value not valid, positive overload"
    assert analog.describe_status(0x80) == "status 80h"
    assert cia406.describe_alarms(0x0001) == "position error"
    assert cia406.describe_alarms(0x1000) == "alarms 1000h"
    assert cia406.describe_warnings(0x0011) == "frequency exceeded, battery charge too low"
