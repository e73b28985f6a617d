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

BO_ 8 Seven: 7 A
 SG_ Low : 36|8@1+ (1,0) [0|0] "" B
 SG_ Last : 50|6@1+ (1,0) [0|0] "" B

BO_ 9 Floats: 8 A
 SG_ Half : 0|16@1- (1,0) [0|0] "" B
 SG_ Single : 16|32@1- (1,0) [0|0] "" B

BO_ 10 Double: 8 A
 SG_ Value : 7|64@0- (1,0) [0|0] "" B

BO_ 2147483655 Wide: 8 A
 SG_ Count : 0|64@1+ (1,0) [0|0] "" B

SIG_VALTYPE_ 1 Real : 1;
SIG_VALTYPE_ 9 Half : 1;
SIG_VALTYPE_ 9 Single : 1;
SIG_VALTYPE_ 10 Value : 2;
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
            reader = dbc.SignalReader(message, names)
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
            reader = dbc.SignalReader(message, [signal.name])
            low, high = writer.bounds
            for _ in range(10):
                raw = chance.uniform(max(low, -1e4), min(high, 1e4))
                if message.name == "Muxed" and signal.name == "Page":
                    raw = chance.randrange(2)
                writer.write(raw)
                assert len(writer.data) == message.length
                accuracy = 1e-3 if signal.is_float and signal.length == 16 else 1e-6
                expected = pytest.approx(raw, abs=0 if signal.is_float else 0.5, rel=accuracy)
                assert reader.read(writer.data)[0] == expected


def test_what_does_not_fit_is_held_at_the_nearest(mixed):
    message = mixed.message("Bounded")
    writer = dbc.Writer(mixed, message, {"Mode": "RUN"}, "Speed")
    writer.write(1e12)
    assert writer.data == bytes.fromhex("E8 03 02 00")  # 100 rpm, as the file allows, in tenths
    writer.write(-1e12)
    assert writer.data == bytes.fromhex("18 FC 02 00")
    half = dbc.Writer(mixed, mixed.message("Floats"), {}, "Half")
    half.write(1e6)
    assert half.data[:2] == bytes.fromhex("FF 7B")  # 65504, the largest of 16 bits
    real = dbc.load(FILES / "odrive_cansimple.dbc")
    writer = dbc.Writer(real, real.message("Set_Input_Pos"), {}, "Input_Pos")
    writer.write(1e300)
    assert math.isfinite(dbc.SignalReader(real.message("Set_Input_Pos"), ["Input_Pos"]).read(writer.data)[0])


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
        ("Floats", ["Half", "Single"], True),
        ("Double", ["Value"], True),
    ):
        assert dbc.SignalReader(mixed.message(name), signals).is_compiled is is_compiled, (name, signals)


def test_a_page_that_does_not_carry_a_signal_is_no_value(mixed):
    reader = dbc.SignalReader(mixed.message("Muxed"), ["Speed", "Heat"])
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


def test_a_message_whose_signals_overlap_is_refused_and_no_other(tmp_path):
    path = tmp_path / "overlap.dbc"
    path.write_text(
        'VERSION ""\nBU_: X\nBO_ 5 Right: 8 X\n SG_ Pull : 0|16@1+ (1,0) [0|0] "V" X\n'
        'BO_ 6 Twice: 8 X\n SG_ A : 0|16@1+ (1,0) [0|0] "V" X\n SG_ B : 8|16@1+ (1,0) [0|0] "V" X\n'
    )
    file = dbc.load(path)
    assert [message.name for message in file.messages] == ["Right"]
    with pytest.raises(ConfigError, match=r"'Twice' of .* cannot be used: The signals B and A are overlapping"):
        file.signal("Twice.A")


def test_slips_that_change_no_value_are_mended(tmp_path):
    """Names of values of a signal that is not there, also over two lines, an identifier of 29 bits without its mark."""
    text = MIXED.replace("BO_ 2147483655 Wide", "BO_ 419364900 Wide")
    text += 'CM_ SG_ 419364900 Count "twice VAL_ 6 No 1 ;";\nBA_DEF_ BO_ "GenMsgCycleTime" INT 0 1000;\n'
    text += 'BA_ "GenMsgCycleTime" BO_ 419364900 20;\nSIG_VALTYPE_ 419364900 Count : 0;\n'
    text += 'VAL_ 6 Gone 0 "OFF; or not" -1 "ON" ;\nVAL_ 6 Speed 0 "STILL"\n 1 "SLOW" ;\nVAL_ 77 Mode 0 "OFF" ;\n'
    text += 'VAL_ 419364900 Count 3 "THREE" ;\n'
    text += '\nBO_ 3221225472 VECTOR__INDEPENDENT_SIG_MSG: 0 A\n SG_ Lost : 0|1@1+ (1,0) [0|0] "" B\n\n'
    text += 'VAL_ 3221225472 Lost 0 "NO" ;\n'
    path = tmp_path / "slips.dbc"
    path.write_text(text)
    file = dbc.load(path)
    wide, count = file.signal("Wide.Count")
    assert (wide.frame_id, wide.is_extended_frame, wide.cycle_time, wide.length) == (419364900, True, 20, 8)
    assert dbc.describe(count, 3) == "three"
    assert dbc.describe(file.signal("Bounded.Speed")[1], 1) == "slow"
    assert dbc.describe(file.signal("Bounded.Mode")[1], 2) == "run"
    assert {message.name for message in file.messages} == {message.name for message in load(tmp_path, MIXED).messages}


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8", "utf-8-sig"])
def test_units_have_their_letters(tmp_path, encoding):
    path = tmp_path / "units.dbc"
    path.write_bytes(MIXED.replace('"rpm" B', '"\xb0C" B').encode(encoding))
    assert dbc.load(path).signal("Muxed.Speed")[1].unit == "\xb0C"


def test_an_error_names_the_line_of_the_file(tmp_path):
    text = MIXED + 'VAL_ 6 Gone 0 "OFF"\n 1 "ON" ;\nBO_ 12 2nd: 8 A\n'
    with pytest.raises(ConfigError, match=f"line {text[: text.index('BO_ 12')].count(chr(10)) + 1},"):
        load(tmp_path, text)


def load(folder, text):
    path = folder / "plain.dbc"
    path.write_text(text)
    return dbc.load(path)


def test_raw_values_in_words():
    errors = dbc.load(FILES / "odrive_cansimple.dbc").signal("Heartbeat.Axis_Error")[1]
    assert dbc.describe(errors, 0, is_bits=True) == "none"
    assert dbc.describe(errors, 0x2200, is_bits=True) == "dc bus under voltage, motor over temp"
    assert dbc.describe(errors, 0x80, is_bits=True) == "bit 7"
    assert dbc.describe(errors, 3) == "3"
    assert dbc.describe(errors, math.nan) == "unknown"


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("Mixed.Little", -2048, 2047),
        ("Mixed.Flag", 0, 1),
        ("Mixed.Big", -32768, 32767),
        ("Mixed.Real", -3.4e38, 3.4e38),
        ("BigBits.Head", 0, 1023),
        ("Bounded.Speed", -1000, 1000),
        ("Bounded.Mode", 0, 255),
        ("Wide.Count", 0, 2**64 - 1),
        ("Floats.Half", -65504, 65504),
        ("Double.Value", -math.inf, math.inf),
    ],
)
def test_the_smallest_and_largest_raw_value(mixed, name, low, high):
    assert dbc.raw_bounds(mixed.signal(name)[1]) == (pytest.approx(low), pytest.approx(high))


@pytest.mark.parametrize(
    ("name", "value", "raw"),
    [
        ("Mixed.Little", 6.0, 10),  # (6 - 1) / 0.5
        ("Mixed.Little", -2.0, -6),
        ("Mixed.Little", 1.3, 1),  # 0.6, to the nearest
        ("Mixed.Little", 1024.5, 2047),
        ("Mixed.Real", 0.3, 0.3),
        ("BigBits.Tail", 7.0, 5),  # (7 + 3) / 2
        ("Bounded.Mode", "RUN", 2),
        ("Bounded.Mode", 255, 255),
        ("Bounded.Speed", -100.0, -1000),
    ],
)
def test_a_value_of_the_file_as_a_raw_value(mixed, name, value, raw):
    signal = mixed.signal(name)[1]
    assert mixed.raw(signal, value) == raw
    assert isinstance(mixed.raw(signal, value), int) == (name != "Mixed.Real")


@pytest.mark.parametrize(
    ("name", "value"),
    [("Mixed.Little", 1025.0), ("Mixed.Little", -1024.0), ("Bounded.Speed", 100.2), ("Mixed.Flag", -1)],
)
def test_a_value_that_does_not_fit(mixed, name, value):
    with pytest.raises(ConfigError, match="does not fit"):
        mixed.raw(mixed.signal(name)[1], value)


@pytest.mark.parametrize(
    ("message", "data", "values"),
    [
        # bits counted by hand: Flag is bit 3, Little bits 4 to 15, Big bytes 2 and 3 with the highest first
        ("Mixed", "08 00 00 00 00 00 00 00", {"Flag": 1, "Little": 0, "Big": 0}),
        ("Mixed", "10 00 00 00 00 00 00 00", {"Flag": 0, "Little": 1}),
        ("Mixed", "F0 FF 00 00 00 00 00 00", {"Little": -1}),
        ("Mixed", "00 80 00 00 00 00 00 00", {"Little": -2048}),
        ("Mixed", "00 00 01 02 00 00 80 3F", {"Big": 0x0102, "Real": 1.0}),
        ("Mixed", "00 00 FF FE 00 00 00 00", {"Big": -2}),
        # Head: bits 5 to 0 of byte 0, then bits 7 to 4 of byte 1. Tail: from bit 6 of byte 3, 17 bits
        ("BigBits", "20 10 00 00 00 00", {"Head": 0x201}),
        ("BigBits", "3F F0 00 00 00 00", {"Head": 1023}),
        ("BigBits", "00 00 00 40 00 00", {"Tail": -65536}),
        ("BigBits", "00 00 00 00 00 40", {"Tail": 1}),
        ("BigBits", "00 00 00 00 01 00", {"Tail": 4}),
        ("Words", "FF FE 00 00 00 00 01 02", {"First": -2, "Second": 0x0102}),
        ("Seven", "00 00 00 00 50 0A FC", {"Low": 0xA5, "Last": 63}),
        ("Wide", "01 00 00 00 00 00 00 80", {"Count": 2**63 + 1}),
        ("Floats", "00 3E 00 00 20 C1 00 00", {"Half": 1.5, "Single": -10.0}),  # IEEE 754
        ("Double", "C0 24 00 00 00 00 00 00", {"Value": -10.0}),
    ],
)
def test_frames_written_out_by_hand(mixed, message, data, values):
    for names in (list(values), *([name] for name in values)):
        reader = dbc.SignalReader(mixed.message(message), names)
        found = dict(zip(reader.names, reader.read(bytes.fromhex(data)), strict=True))
        assert found == {name: values[name] for name in names}


def test_start_values_and_values_that_do_not_change(mixed):
    writer = dbc.Writer(mixed, mixed.message("Mixed"), {"Flag": 1, "Little": 1.5}, "Big")
    assert writer.data == bytes.fromhex("18 00 00 00 00 00 00 00")
    writer.write(0x0102 + 0.4)
    assert writer.data == bytes.fromhex("18 00 01 02 00 00 00 00")
    writer.write(-2)
    assert writer.data == bytes.fromhex("18 00 FF FE 00 00 00 00")
    little = dbc.Writer(mixed, mixed.message("Mixed"), {"Big": 1}, "Little")
    little.write(-1)
    assert little.data == bytes.fromhex("F0 FF 00 01 00 00 00 00")
    assert dbc.Writer(mixed, mixed.message("Empty"), {}).data == b""


def test_many_names_are_not_all_listed():
    body = "".join(f"BO_ {number} Message{number}: 0 A\n\n" for number in range(1, 43))
    file = dbc.Dbc(Path("many.dbc"), dbc.cantools.database.load_string(HEAD + body, database_format="dbc"))
    with pytest.raises(ConfigError) as caught:
        file.message("Nothing of the kind")
    assert str(caught.value).count("Message") == 40
    assert "and 2 more" in str(caught.value)
    with pytest.raises(ConfigError, match=r"Did you mean \w+ or \w+ or \w+\? It has"):
        file.message("Message")


def test_bits_without_a_name():
    errors = dbc.load(FILES / "odrive_cansimple.dbc").signal("Heartbeat.Axis_Error")[1]
    assert dbc.describe(errors, 1 << 31, is_bits=True).startswith("bit 31") or errors.length < 32
    assert dbc.describe(errors, 0x2000) == "motor over temp"
    assert dbc.describe(errors, math.inf) == "unknown"
