"""DBC files: what is read from and written to a frame is what cantools would, only sooner; wrong names are told."""

import math
import random
from pathlib import Path

import pytest

from hal.errors import ConfigError
from hal.protocols import dbc

FILES = Path(__file__).resolve().parents[2] / "robots" / "dbc"
HEAD = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A B\n\n'
MIXED = (
    HEAD
    + """BO_ 1 Mixed: 8 A
 SG_ Little : 4|12@1- (0.5,1) [0|0] "" B
 SG_ Flag : 3|1@1+ (1,0) [0|0] "" B
 SG_ Big : 23|16@0- (1,0) [0|0] "" B
 SG_ Real : 32|32@1- (1,0) [0|0] "" B

BO_ 2 BigBits: 6 A
 SG_ Head : 5|10@0+ (1,0) [0|0] "" B
 SG_ Tail : 30|17@0- (2,-3) [0|0] "" B

BO_ 3 Muxed: 8 A
 SG_ Page M : 0|8@1+ (1,0) [0|0] "" B
 SG_ Speed m0 : 8|16@1- (0.1,0) [0|0] "rpm" B
 SG_ Heat m1 : 8|8@1+ (1,-40) [0|0] "degC" B

BO_ 4 Words: 8 A
 SG_ First : 7|16@0- (1,0) [0|0] "" B
 SG_ Second : 39|32@0+ (1,0) [0|0] "" B

BO_ 5 Empty: 0 B

BO_ 6 Bounded: 4 B
 SG_ Speed : 0|16@1- (0.1,0) [-100|100] "rpm" A
 SG_ Mode : 16|8@1+ (1,0) [0|0] "" A

BO_ 2147483655 Wide: 8 A
 SG_ Count : 0|64@1+ (1,0) [0|0] "" B

SIG_VALTYPE_ 1 Real : 1;
VAL_ 6 Mode 0 "OFF" 2 "RUN" ;
"""
)


@pytest.fixture
def mixed(tmp_path):
    path = tmp_path / "mixed.dbc"
    path.write_text(MIXED)
    return dbc.load(path)


def every_message(mixed):
    for file in (mixed, dbc.load(FILES / "odrive_cansimple.dbc"), dbc.load(FILES / "load_cell.dbc")):
        for message in file.messages:
            yield file, message


def same(found, expected):
    return len(found) == len(expected) and all(
        a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(found, expected, strict=True)
    )


def test_reads_what_cantools_reads(mixed):
    chance = random.Random(1)
    compiled = 0
    for _, message in every_message(mixed):
        for names in [[s.name for s in message.signals], *([s.name] for s in message.signals)]:
            reader = dbc.Reader(message, names)
            compiled += reader.is_compiled
            for _ in range(20):
                data = chance.randbytes(message.length)
                expected = reader._decode(data)
                found = reader.read(data)
                if expected is None:  # a page that the file does not have
                    assert found is None or names == ["Page"]
                    continue
                assert same(found, expected), (message.name, names)
    assert compiled > 60


def test_writes_what_cantools_reads_back(mixed):
    chance = random.Random(2)
    for file, message in every_message(mixed):
        for signal in message.signals:
            others = {"Page": int(signal.name == "Heat")} if message.name == "Muxed" else {}
            writer = dbc.Writer(file, message, others, signal.name)
            reader = dbc.Reader(message, [signal.name])
            low, high = writer.bounds
            for _ in range(10):
                raw = chance.uniform(max(low, -1e4), min(high, 1e4))
                if message.name == "Muxed" and signal.name == "Page":
                    raw = chance.randrange(2)
                writer.write(raw)
                assert len(writer.data) == message.length
                assert reader.read(writer.data)[0] == pytest.approx(raw, abs=0 if signal.is_float else 0.5, rel=1e-6)


def test_what_does_not_fit_is_held_at_the_nearest(mixed):
    message = mixed.message("Bounded")
    writer = dbc.Writer(mixed, message, {"Mode": "RUN"}, "Speed")
    writer.write(1e12)
    assert writer.data == bytes.fromhex("E8 03 02 00")  # 100 rpm, as the file allows, in tenths
    writer.write(-1e12)
    assert writer.data == bytes.fromhex("18 FC 02 00")
    real = dbc.load(FILES / "odrive_cansimple.dbc")
    writer = dbc.Writer(real, real.message("Set_Input_Pos"), {}, "Input_Pos")
    writer.write(1e300)
    assert math.isfinite(dbc.Reader(real.message("Set_Input_Pos"), ["Input_Pos"]).read(writer.data)[0])


def test_whole_bytes_and_whole_numbers_need_no_cantools(mixed):
    for name, signals, is_compiled in (
        ("Mixed", ["Real"], True),
        ("Mixed", ["Little", "Flag"], True),
        ("Mixed", ["Little", "Real"], False),
        ("Mixed", ["Little", "Big"], False),
        ("BigBits", ["Head", "Tail"], True),
        ("Muxed", ["Page"], True),
        ("Muxed", ["Speed"], False),
        ("Words", ["First", "Second"], True),
        ("Wide", ["Count"], True),
    ):
        assert dbc.Reader(mixed.message(name), signals).is_compiled is is_compiled, (name, signals)


def test_a_page_that_does_not_carry_a_signal_is_no_value(mixed):
    reader = dbc.Reader(mixed.message("Muxed"), ["Speed", "Heat"])
    speed, heat = reader.read(bytes.fromhex("00 0A 00 00 00 00 00 00"))
    assert speed == 10
    assert math.isnan(heat)
    assert reader.read(bytes.fromhex("09 0A 00 00 00 00 00 00")) is None


@pytest.mark.parametrize(
    ("ask", "sentence"),
    [
        (lambda file: file.message("Mixd"), "has no message 'Mixd'. Did you mean Mixed"),
        (lambda file: file.signal("Mixed.Larg"), "has no signal 'Larg'. It has: Big, Flag, Little, Real"),
        (lambda file: file.signal("Mixed"), "does not have the form `Message.Signal`"),
        (lambda file: file.raw(file.signal("Bounded.Mode")[1], "RUNS"), "Did you mean RUN"),
        (lambda file: file.raw(file.signal("Bounded.Mode")[1], 256), "256 does not fit into signal 'Mode'"),
        (lambda file: dbc.Writer(file, file.message("Bounded"), {"Mod": 1}), "Did you mean Mode"),
        (lambda file: dbc.Writer(file, file.message("Muxed"), {"Page": 7}), "cannot be made of"),
    ],
)
def test_a_name_or_value_that_is_not_there_is_told_with_those_that_are(mixed, ask, sentence):
    with pytest.raises(ConfigError, match=sentence.replace(".", r"\.")):
        ask(mixed)


def test_a_file_that_is_none_is_told(tmp_path):
    with pytest.raises(ConfigError, match="no DBC file"):
        dbc.load(tmp_path / "missing.dbc")
    (tmp_path / "broken.dbc").write_text("BO_ this is no DBC file")
    with pytest.raises(ConfigError, match="not a DBC file"):
        dbc.load(tmp_path / "broken.dbc")


def test_raw_values_in_words():
    errors = dbc.load(FILES / "odrive_cansimple.dbc").signal("Heartbeat.Axis_Error")[1]
    assert dbc.describe(errors, 0, is_bits=True) == "none"
    assert dbc.describe(errors, 0x2200, is_bits=True) == "dc bus under voltage, motor over temp"
    assert dbc.describe(errors, 0x80, is_bits=True) == "bit 7"
    assert dbc.describe(errors, 3) == "3"
    assert dbc.describe(errors, math.nan) == "unknown"
