"""Which objects travel in which PDO, and what is said of a layout that a node cannot have."""

import canopen
import pytest
from hal_bench import ROBOTS
from pydantic import ValidationError

from hal.commissioning.pdo_map import Pdo, PdoMap, PdoSettings, check_map, lay_out
from hal.errors import ConfigError
from hal.protocols import cia301
from hal.protocols.cia301 import MappedObject

STATUS, POSITION, VELOCITY = (
    MappedObject(0x6041, 0, 16),
    MappedObject(0x6064, 0, 32, "signed"),
    MappedObject(0x606C, 0, 32, "signed"),
)
TORQUE, MODE = MappedObject(0x6077, 0, 16, "signed"), MappedObject(0x6061, 0, 8, "signed")


@pytest.fixture(scope="module")
def sheet():
    return canopen.import_od(str(ROBOTS / "eds" / "servo_drive.eds"))


def test_objects_are_kept_in_order_and_fill_the_first_frame_with_room():
    first, second = lay_out((STATUS, POSITION, VELOCITY, TORQUE, MODE, STATUS))
    assert first.objects == (STATUS, POSITION, TORQUE)
    assert second.objects == (VELOCITY, MODE)
    assert (first.number, first.size, second.number, second.size) == (1, 8, 2, 5)
    assert first.layout.unpack(bytes.fromhex("37 02 F0 D8 FF FF 9C FF")) == (0x0237, -10_000, -100)
    assert first.layout.size == 8


def test_nothing_needs_no_frame():
    assert lay_out(()) == ()


def test_frames_per_second_follow_the_transmission():
    pdos = PdoMap(
        lay_out((MappedObject(0x6040, 0, 16),)),
        (Pdo(1, (STATUS, POSITION)), Pdo(2, (TORQUE,), 20), Pdo(3, (MODE,), 254, 0.25), Pdo(4, (MODE,), 255)),
    )
    assert pdos.frames(200.0) == ((2, 200.0), (6, 200.0), (2, 10.0), (1, 4.0), (1, 0.0))
    assert [pdo.answers_sync for pdo in pdos.sends] == [True, False, False, False]


@pytest.mark.parametrize(
    ("text", "kind", "entry", "form"),
    [
        ("2200h:1", "int16", 0x22000110, "h"),
        ("6064h", "int32", 0x60640020, "i"),
        ("0x6130:2", "float32", 0x61300220, "f"),
        ("1a00", "uint8", 0x1A000008, "B"),
    ],
)
def test_objects_as_a_person_writes_them(text, kind, entry, form):
    item = cia301.mapped(text, kind)
    assert (item.entry, item.format) == (entry, form)


@pytest.mark.parametrize(("text", "kind"), [("6064", "int24"), ("664h", "int8"), ("6064h:300", "int8"), ("x", "int8")])
def test_what_is_no_object_is_refused(text, kind):
    with pytest.raises(ValueError, match=text if kind == "int8" else "Known: uint8"):
        cia301.mapped(text, kind)


def test_a_layout_from_the_robot_file():
    settings = PdoSettings.model_validate(
        {
            "sends": [
                {"number": 1, "objects": ["6041h uint16", "6064h:0 int32"]},
                {"number": 3, "objects": ["2200h:1 int16"], "transmission": 254, "event_time": 0.1},
            ],
            "receives": [{"number": 2, "objects": ["6040h uint16"]}],
            "fixed": True,
        }
    )
    assert settings.map("it") == PdoMap(
        (Pdo(2, (MappedObject(0x6040, 0, 16),)),),
        (Pdo(1, (STATUS, POSITION)), Pdo(3, (MappedObject(0x2200, 1, 16, "signed"),), 254, 0.1)),
        is_fixed=True,
    )


@pytest.mark.parametrize(
    ("entries", "report"),
    [
        ([{"number": 1, "objects": ["6041h"]}], "'6041h': '' is not a type of an object"),
        ([{"number": 1, "objects": ["status uint16"]}], "'status' is not an object such as 6064h or 2200h:1"),
        ([{"number": 1, "objects": ["6064h int32", "606Ch int32", "6061h int8"]}], "are 9 bytes, a PDO has 8"),
        ([{"number": 1, "objects": ["6041h uint16"], "transmission": 250}], "transmission 250 is reserved"),
        ([{"number": 1, "objects": ["6041h uint16"], "transmission": 254}], "event_time belongs to transmission 254"),
        ([{"number": 1, "objects": ["6041h uint16"], "event_time": 1.0}], "event_time belongs to transmission 254"),
        ([{"number": 1, "objects": ["6041h uint16"]}] * 2, "pdo.sends names a number twice: 1, 1"),
    ],
)
def test_a_layout_that_makes_no_sense_is_told(entries, report):
    with pytest.raises(ConfigError, match=report):
        PdoSettings.model_validate({"sends": entries}).map("'elbow'")


@pytest.mark.parametrize("entry", [{"number": 5, "objects": ["6041h uint16"]}, {"number": 1, "objects": []}])
def test_numbers_and_objects_are_bounded(entry):
    with pytest.raises(ValidationError):
        PdoSettings.model_validate({"sends": [entry]})


def test_a_layout_that_the_data_sheet_allows(sheet):
    check_map(PdoMap(lay_out((MappedObject(0x6040, 0, 16),)), lay_out((STATUS, POSITION, TORQUE))), sheet, "'elbow'")


@pytest.mark.parametrize(
    ("receives", "sends", "report"),
    [
        ((), (MappedObject(0x6099, 9, 32),), "'elbow' cannot send 6099h:9 by PDO: its data sheet has no such object"),
        (
            (),
            (MappedObject(0x6502, 0, 32),),
            "'elbow' cannot send 6502h:0 by PDO: .* 'Supported drive modes' cannot be",
        ),
        (
            (),
            (MappedObject(0x6064, 0, 16),),
            "'elbow' cannot send 6064h:0 as 16 bits: .* 'Position actual value' 32 bits",
        ),
        ((STATUS,), (), "'elbow' cannot receive 6041h:0 by PDO: .* 'Statusword' is read only"),
    ],
)
def test_a_layout_that_the_data_sheet_does_not_allow_names_the_object(sheet, receives, sends, report):
    with pytest.raises(ConfigError, match=report):
        check_map(PdoMap(lay_out(receives), lay_out(sends)), sheet, "'elbow'")


def test_more_pdos_than_the_node_has(sheet):
    many = tuple(Pdo(number, (STATUS,)) for number in range(1, 6))
    with pytest.raises(ConfigError, match=r"'elbow' would need TPDO\d to send 6041h:0 \(16 bit\); its data sheet has"):
        check_map(PdoMap((), many), sheet, "'elbow'")
