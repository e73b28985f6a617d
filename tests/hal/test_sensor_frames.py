"""CANopen sensors frame by frame: channels and their status, frozen values, tare, and a second node under one id."""

import contextlib
import math
import time
from pathlib import Path

import pytest
from puppet import NODE, ROBOTS, driven, report

from hal.device import DeviceState
from hal.drivers.canopen import analog as channels
from hal.drivers.canopen.analog import Cia401Input, Cia404Cell, parse
from hal.drivers.canopen.cia406 import Cia406Encoder
from hal.errors import CommandRefused, ConfigError, DeviceRefused
from hal.protocols import analog, cia301

CELL = {"1000:0": "94 01 02 00", "1018:2": "04 04 00 00", "6131:1": "00 00 21 00", "6132:1": "02"}
INPUTS = {"1000:0": "91 01 04 00", "1018:2": "01 04 00 00"}
ENCODER = {
    "1000:0": "96 01 01 00",
    "1018:2": "06 04 00 00",
    "6000:0": "00 00",
    "6031:3": "01 00",
    "6031:4": "01 00",
    "6501:0": "00 10 00 00",
    "6502:0": "10 00",
}
TPDO, EMERGENCY, HEARTBEAT = 0x180 + NODE, 0x080 + NODE, 0x700 + NODE
GOOD = bytes.fromhex("E8 03 00 00 00")
"""10.00 N in hundredths, and a good status."""


@contextlib.contextmanager
def cell(quantities=("force",), objects=CELL, **settings):
    elements = {quantity: f"muscle_tension.m{n}" for n, quantity in enumerate(quantities)}
    with driven(Cia404Cell, elements, {"eds": "eds/load_cell.eds", **settings}, objects) as (device, puppet):
        yield device, puppet


def hear(device, data, received=1.0, missed=1, cob_id=TPDO):
    device.missed = missed
    device._bus.subscriber(cob_id)(bytearray(data), received)


def cycle(device, extra=0, missed=1):
    """One cycle with an answer, and frames that come on top of it."""
    hear(device, GOOD, missed=missed)
    for _ in range(extra):
        device._bus.subscriber(TPDO)(bytearray(GOOD), 1.0)


def test_a_second_node_is_found_after_20_cycles():
    """An extra frame counts 3, an expected one -1; more than 40 is another node."""
    with cell() as (device, _):
        for _ in range(19):
            cycle(device, extra=1)
            assert device._fault() == ""
        cycle(device, extra=1)
        assert "answers each SYNC twice. Do two devices have this node id?" in device._fault()
        assert device.health().counters["doubled"] == 20
        device.reset()
        assert device._fault() == ""
        for _ in range(19):
            cycle(device, extra=1)
        assert device._fault() == ""
        for _ in range(39):
            cycle(device)
        assert device._doubt == 0.0
        cycle(device)
        assert device._doubt == 0.0


def test_frames_that_come_late_are_no_second_node():
    """Each cycle without an answer explains one frame more; this is forgotten by 1/16 of a frame's weight per cycle."""
    with cell() as (device, _):
        cycle(device, missed=3)
        assert device._doubt == -6.0
        for _ in range(16):
            cycle(device)
        assert device._doubt == pytest.approx(-5.0)
        cycle(device, missed=2)
        assert device._doubt == pytest.approx(-8.0)
        cycle(device, missed=150)
        cycle(device, missed=150)
        assert device._doubt == -600.0
        device._doubt = 0.0
        cycle(device, missed=1000)
        assert device._doubt == -600.0


def test_an_answer_of_two_frames_is_complete_with_both():
    quantities = ("force_1", "force_2", "force_3")
    objects = CELL | {f"6131:{n}": "00 00 21 00" for n in (2, 3)} | {f"6132:{n}": "02" for n in (2, 3)}
    with cell(quantities, objects, channels=[1, 2, 3], preset="int16") as (device, _):
        first, second = bytes(6), bytes(3)
        hear(device, first)
        assert device.missed == 1
        hear(device, second, cob_id=TPDO + 0x100)
        assert device.missed == 0
        hear(device, second, cob_id=TPDO + 0x100)
        hear(device, first, missed=2)  # of the next cycle: the frame before does not complete it
        assert device.missed == 2
        hear(device, second, missed=2, cob_id=TPDO + 0x100)
        assert device.missed == 0
        assert device._doubt == -6.0  # two frames of one late cycle
        assert device.health().counters["doubled"] == 0
        hear(device, first)
        hear(device, first)
        assert device.health().counters["doubled"] == 1


@pytest.mark.parametrize(("silent_after", "patience"), [(0.15, 0.25), (0.4, 0.4)])
def test_process_data_without_a_heartbeat_is_a_firmware_that_hangs(silent_after, patience):
    """Two and a half heartbeats of 0.1 s, or `silent_after`."""
    with cell(silent_after=silent_after) as (device, _):
        device._bus.subscriber(HEARTBEAT)(bytearray((0x05,)), 10.0)
        hear(device, GOOD, 10.0 + patience - 0.001)
        assert device.is_commissioned
        assert device.missed == 0
        hear(device, GOOD, 10.0 + patience + 0.001)
        assert not device.is_commissioned
        assert "without a heartbeat" in device.health().text


@pytest.mark.parametrize(("state", "is_commissioned"), [(0x05, True), (0x85, True), (0x7F, False), (0x04, False)])
def test_states_in_a_heartbeat(state, is_commissioned):
    with cell() as (device, _):
        device._bus.subscriber(HEARTBEAT)(bytearray((state,)), 10.0)
        assert device.is_commissioned is is_commissioned
        if not is_commissioned:
            assert "left the operational state by itself." in device.health().text


def test_the_reason_for_leaving_the_operational_state_is_the_emergency():
    with cell() as (device, _):
        device._bus.subscriber(EMERGENCY)(bytearray.fromhex("10 42 09 00 00 00 00 00"), 1.0)
        assert "4210h" in device._fault()
        device._bus.subscriber(HEARTBEAT)(bytearray((0x7F,)), 10.0)
        assert "by itself, after reporting device temperature" in device.health().text
        device.reset()
        assert device._fault() == ""


@pytest.mark.parametrize("how", ["emergency", "twin", "none"])
def test_values_during_a_fault_are_not_valid(how):
    with cell() as (device, _):
        if how == "emergency":
            device._bus.subscriber(EMERGENCY)(bytearray.fromhex("10 42 09 00 00 00 00 00"), 1.0)
        elif how == "twin":
            device._report_twin("is twice there")
        hear(device, GOOD)
        device.missed = 0
        assert device.read().values[0] == pytest.approx(math.nan if how != "none" else 10.0, nan_ok=True)
        assert device._troubles() == ([] if how == "none" else ["force: the device reports a fault"])


@pytest.mark.parametrize(
    ("status", "text"),
    [(0x00, None), (0x01, "value not valid"), (0x06, "positive overload, negative overload"), (0x10, "status 10h")],
)
@pytest.mark.long
def test_a_status_in_words(status, text):
    with cell() as (device, _):
        hear(device, GOOD[:4] + bytes((status,)))
        device.missed = 0
        assert device._troubles() == ([f"force: {text}"] if text else [])
        assert (device.health().text == "") is (text is None)
        assert device.health().state is DeviceState.READY
    with cell(status="6150h uint8", bad_status=0x10) as (device, _):
        hear(device, GOOD[:4] + bytes((status,)))
        assert device._troubles() == (["force: status 10h"] if status == 0x10 else [])


@pytest.mark.parametrize(("waited", "is_frozen"), [(0.5, False), (0.51, True)])
def test_a_value_that_does_not_change_by_a_bit(waited, is_frozen):
    with cell(frozen_after=0.5) as (device, _):
        hear(device, GOOD, 1.0)
        hear(device, GOOD, 1.0 + waited)
        assert math.isnan(device.read().values[0]) is is_frozen
        assert any("for more than 0.5 s" in text for text in device._troubles()) is is_frozen
        hear(device, bytes.fromhex("E9 03 00 00 00"), 1.0 + waited)
        assert device.read().values[0] == pytest.approx(10.01)
        assert device.read().received[0] == 1.0 + waited


@pytest.mark.parametrize(
    ("value", "kind", "low", "high"),
    [
        ("7130h int16", "int16", -32768, 32767),
        ("7130h uint16", "uint16", -1, 65535),
        ("7130h int8", "int8", -128, 127),
        ("7130h uint32", "uint32", -1, 2**32 - 1),
        ("6130h float32", "float32", -math.inf, math.inf),
    ],
)
def test_the_ends_of_a_type_are_an_overload(value, kind, low, high):
    item = parse(value, 1, "value")
    assert channels.AnalogNode._bounds(None, None, item) == (low, high)
    assert (item.index, item.subindex) == (int(value[:4], 16), 1)
    assert parse(value.replace("h ", "h:7 "), 1, "value").subindex == 7
    with pytest.raises(ConfigError, match="Write an object and its type"):
        parse(value.split()[0], 1, "value")


@pytest.mark.parametrize(
    ("resolution", "bits", "high"),
    [(12, 16, 0x7FF0), (16, 16, 0x7FFF), (24, 16, 0x7FFF), (2, 16, 0x4000), (24, 32, 0x7FFFFF00), (None, 16, 0x7FFF)],
)
@pytest.mark.long
def test_an_input_of_fewer_bits_is_shifted_to_the_left(resolution, bits, high):
    settings = {"eds": "eds/analog_input.eds", "gain": 1.0, "preset": f"int{bits}", "resolution": resolution}
    with driven(Cia401Input, {"force": "f.a"}, settings, INPUTS, is_open=False) as (device, _):
        assert device._channels[0].bounds == (-(1 << bits - 1), high)


def mapped(*statuses, bits=16):
    """How channels with these status objects are mapped: objects by PDO."""
    items = [cia301.MappedObject(0x7130, n, bits, "signed") for n in range(1, len(statuses) + 1)]
    parsed = [status and cia301.mapped(status, "uint8") for status in statuses]
    return [[str(item) for item in pdo.objects] for pdo in channels._map(list(zip(items, parsed, strict=True))).sends]


def test_channels_and_their_status_are_mapped_together():
    assert mapped("6150h:1") == [["7130h:1", "6150h:1"]]
    assert mapped("6150h:1", "6150h:2", "6150h:3") == [
        ["7130h:1", "6150h:1", "7130h:2", "6150h:2"],
        ["7130h:3", "6150h:3"],
    ]
    assert mapped("2120h:0", "2120h:0", "2120h:0") == [["2120h:0", "7130h:1", "7130h:2", "7130h:3"]]
    assert mapped(None, None) == [["7130h:1", "7130h:2"]]
    assert mapped("6150h:1", None) == [["7130h:1", "6150h:1", "7130h:2"]]


def test_gains_and_zeros_are_one_for_all_or_one_per_channel():
    quantities = ("force_2", "force_4")
    given = {"channels": [2, 4], "preset": "counts16"}
    for gain, zero, values in ((2.0, 1.0, [21.0, 41.0]), ([2.0, 3.0], [0.5, -1.0], [20.5, 59.0])):
        with cell(quantities, gain=gain, zero=zero, **given) as (device, puppet):
            assert report(device, puppet, "0A 00 00 14 00 00") == pytest.approx(values)
    for wrong in ([1.0], [1.0, 2.0, 3.0]):
        with (
            pytest.raises(ConfigError, match=rf"gain has {len(wrong)} numbers for 2 channels"),
            cell(quantities, gain=wrong, **given),
        ):
            raise AssertionError
    with pytest.raises(ConfigError, match="a gain of zero"), cell(quantities, gain=[1.0, 0.0], **given):
        raise AssertionError
    with cell(preset="int32", digits=0, unit="kN") as (device, puppet):  # without a gain it is 1
        assert report(device, puppet, "02 00 00 00 00") == [pytest.approx(2000.0)]


def test_traffic_of_the_channels_in_use():
    settings = Cia404Cell.Settings.model_validate({"eds": "e", "channels": [1, 2, 3], "preset": "int16"})
    names = Cia404Cell.quantities(settings)
    assert names == ("force_1", "force_2", "force_3")
    assert Cia404Cell.traffic_of(settings, 200.0, names, Path()) == ((6, 200.0), (3, 200.0), (1, pytest.approx(10.0)))
    assert Cia404Cell.traffic_of(settings, 200.0, ("force_2",), Path()) == ((3, 200.0), (1, pytest.approx(10.0)))


def test_units_and_digits_of_a_cell():
    with cell(digits=1) as (device, puppet):
        assert report(device, puppet, GOOD.hex()) == [pytest.approx(100.0)]
    with cell(value="6130h float32") as (device, puppet):  # a whole number has digits, a float has not
        assert report(device, puppet, "00 00 C0 3F 00") == [pytest.approx(1.5)]
    with pytest.raises(DeviceRefused, match="unit 00220000h"), cell(objects=CELL | {"6131:1": "00 00 22 00"}):
        raise AssertionError
    with pytest.raises(ConfigError, match=r"'lb' is no unit of force\. Known: N, mN, kN, kg, g"), cell(unit="lb"):
        raise AssertionError


def test_a_status_that_cannot_be_mapped_is_left_out():
    """By the data sheet 6150h:5 exists and cannot be mapped."""
    with cell(channels=[5], value="7130h:1 int16", digits=0, unit="N") as (device, puppet):
        assert [str(item) for item in device.pdos.sends[0].objects] == ["7130h:1"]
        assert report(device, puppet, "07 00") == [7.0]


def test_a_tare_is_restored_when_the_cell_is_commissioned_again():
    with cell(objects={**CELL, "6124:1": "00 00 C0 BF"}) as (device, puppet):
        device.tare()
        assert device._troubles() == ["being tared"]
        device.long_request()
        assert device._troubles() == []
        assert device._offsets == {1: 0xBFC00000}
        puppet.objects["6124:1"] = bytes(4)
        device.open()
        assert puppet.objects["6124:1"] == bytes.fromhex("00 00 C0 BF")
        puppet.objects["6124:1"] = bytes.fromhex("00 00 C0 7F")
        device.tare()
        device.long_request()
        assert "not tared: 'cell'" in device._troubles()[0]
        assert "no number" in device._troubles()[0]
        assert device.health().counters["tared"] == 1
        device._lose("a test")
        with pytest.raises(CommandRefused, match="cannot be tared: a test"):
            device.tare()


def encoder(objects=ENCODER, quantities=("position",), **settings):
    elements = {quantity: f"joint_{quantity}.elbow" for quantity in quantities}
    return driven(Cia406Encoder, elements, {"eds": "eds/joint_encoder.eds", **settings}, objects)


def test_a_node_that_does_not_become_operational_is_refused_after_half_a_second():
    with driven(Cia404Cell, {"force": "f.a"}, {"eds": "eds/load_cell.eds"}, CELL, is_open=False) as (device, puppet):
        reply = puppet._reply
        puppet._reply = lambda cob_id, data: reply(cob_id, data) if cob_id != HEARTBEAT else None
        begun = time.monotonic()
        with pytest.raises(DeviceRefused, match="does not become operational"):
            device.open()
        assert 0.49 < time.monotonic() - begun < 1.4


@pytest.mark.parametrize(
    ("fixed", "objects"),
    [((), ["6004h:0", "6503h:0", "6505h:0"]), (("6505",), ["6004h:0", "6503h:0"]), (("6503", "6505"), ["6004h:0"])],
)
def test_alarms_and_warnings_that_cannot_be_mapped_are_left_out(tmp_path, fixed, objects):
    sections = (ROBOTS / "eds" / "joint_encoder.eds").read_text().split("\n[")
    changed = [text.replace("PDOMapping=1", "PDOMapping=0") if text[:4] in fixed else text for text in sections]
    (tmp_path / "encoder.eds").write_text("\n[".join(changed))
    with encoder(eds=str(tmp_path / "encoder.eds")) as (device, _):
        assert [str(item) for item in device.pdos.sends[0].objects] == objects


@pytest.mark.parametrize(
    ("changes", "settings", "text"),
    [
        ({"6501:0": "00 00 00 00"}, {}, "Give counts_per_turn"),
        ({"6502:0": "00 00"}, {"around": 0.0}, "Remove `around`"),
        ({"6000:0": "04 00", "6001:0": "00 00 00 00", "6002:0": "00 10 00 00"}, {}, "Give counts_per_turn"),
        ({"6000:0": "04 00", "6001:0": "00 10 00 00", "6002:0": "00 00 00 00"}, {"around": 0.0}, "Remove `around`"),
    ],
)
def test_an_encoder_that_does_not_report_its_counts(changes, settings, text):
    with pytest.raises(DeviceRefused, match=text), encoder(ENCODER | changes, **settings):
        raise AssertionError
    if "around" in text:
        with encoder(ENCODER | changes) as (device, _):  # an unknown number of turns has no end
            assert device._range == math.inf
            assert device._angle(10**9) == pytest.approx(10**9 / 4096 * 2 * math.pi)


@pytest.mark.parametrize(
    ("multiplier", "divider", "scale"), [("02 00", "01 00", 0.5), ("01 00", "03 00", 3.0), ("00 00", "00 00", 1.0)]
)
def test_the_unit_of_a_speed(multiplier, divider, scale):
    objects = ENCODER | {"6031:3": multiplier, "6031:4": divider}
    with encoder(objects, ("position", "velocity")) as (device, _):
        assert device._speed_scale == pytest.approx(scale * 2 * math.pi / 4096)
    with encoder(objects, ("position", "velocity"), direction=-1) as (device, _):
        assert device._speed_scale == pytest.approx(-scale * 2 * math.pi / 4096)


@pytest.mark.parametrize(
    ("around", "counts", "turns"),
    [
        (0.0, 32767, 32767 / 4096),
        (0.0, 32768, -8.0),
        (0.0, 65535, -1 / 4096),
        (2 * math.pi, 36863, 36863 / 4096),
        (2 * math.pi, 36864, -7.0),
    ],
)
def test_angles_around_a_center(around, counts, turns):
    """16 turns of 4096 counts: 8 turns to each side of the center, the lower end included."""
    with encoder(around=around) as (device, _):
        assert device._angle(counts) == pytest.approx(turns * 2 * math.pi)


def test_faults_of_an_encoder_in_words():
    quantities = ("position", "velocity")
    with encoder(quantities=quantities) as (device, _):
        device.missed = 0
        assert device.health().text == ""
        hear(device, bytes.fromhex("00 08 00 00 00 00 00 04"))
        device.missed = 0
        assert device.health().text == ""
        hear(device, bytes.fromhex("00 08 00 00 01 00 00 04"))
        device.missed = 0
        assert [math.isnan(value) for value in device.read().values] == [True, True]
        assert "position error" in device.health().text
        hear(device, bytes.fromhex("00 00 01 00 00 00 00 04"))
        device.missed = 0
        assert [math.isnan(value) for value in device.read().values] == [True, False]
        assert "counts beyond its own range" in device.health().text
        device._report_twin("is twice there")
        hear(device, bytes.fromhex("00 08 00 00 00 00 00 04"))
        assert [math.isnan(value) for value in device.read().values] == [True, True]
    settings = Cia406Encoder.Settings.model_validate({"eds": "e"})
    assert Cia406Encoder.quantities(settings) == quantities
    assert Cia406Encoder.traffic(settings, 200.0) == ((8, 200.0), (1, pytest.approx(10.0)))


def test_the_unit_code_of_a_cell_is_that_of_its_channel():
    objects = CELL | {"6131:2": "00 00 21 03", "6132:2": "00"}
    with cell(("force_1", "force_2"), objects, channels=[1, 2], preset="int16") as (device, puppet):
        assert report(device, puppet, "64 00 00 02 00 00") == pytest.approx([1.0, 2000.0])
    assert analog.unit(0x03210000).scale == pytest.approx(1e3)
