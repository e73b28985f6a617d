"""What frames say: golden frames from CiA 301 and from the shipped data sheets."""

from pathlib import Path

import pytest

from hal.config import RobotConfig
from hal.drivers.canopen.node import data_sheet
from hal.finding.book import EXTENDED, Book, Frame
from hal.finding.decode import describe
from hal.finding.robot_book import books
from hal.protocols.cia301 import MappedObject
from hal.protocols.sdo import Upload

EDS = Path(__file__).parents[2] / "robots" / "eds"


def frame(identifier, data="", **more):
    return Frame(0.0, identifier, bytes.fromhex(data), **more)


@pytest.fixture
def book():
    book = Book()
    book.add(3, "elbow_drive", data_sheet(EDS / "servo_drive.eds"))
    book.add(11, "biceps_cell", data_sheet(EDS / "load_cell.eds"))
    return book


GOLDEN = [
    (0x000, "01 03", "NMT", 3, "start: node 3"),
    (0x000, "81 00", "NMT", None, "reset: all nodes"),
    (0x000, "77 00", "NMT", None, "unknown command 77h: all nodes"),
    (0x000, "01", "NMT", None, "malformed"),
    (0x080, "", "SYNC", None, ""),
    (0x080, "07", "SYNC", None, "counter 7"),
    (0x703, "05", "heartbeat", 3, "operational"),
    (0x703, "00", "heartbeat", 3, "boot-up"),
    (0x703, "7F", "heartbeat", 3, "pre-operational"),
    (0x703, "42", "heartbeat", 3, "unknown state 42h"),
    (0x703, "", "heartbeat", 3, "malformed"),
    (
        0x083,
        "30 81 11 00 00 00 00 00",
        "EMCY",
        3,
        "communication: life guard or heartbeat error (8130h), error register 11h",
    ),
    (0x083, "00 00 00 00 00 00 00 00", "EMCY", 3, "all errors are gone"),
    (0x083, "30 81", "EMCY", 3, "malformed"),
    (0x603, "40 41 60 00 00 00 00 00", "SDO", 3, "read 6041h:0 Statusword"),
    (0x583, "4B 41 60 00 37 02 00 00", "SDO", 3, "is 6041h:0 Statusword = 0237h (operation enabled)"),
    (0x583, "43 64 60 00 FE FF FF FF", "SDO", 3, "is 6064h:0 Position actual value = -2"),
    (0x603, "2B 40 60 00 0F 00 00 00", "SDO", 3, "write 6040h:0 Controlword = 000Fh"),
    (0x583, "60 40 60 00 00 00 00 00", "SDO", 3, "took 6040h:0 Controlword"),
    (0x583, "80 41 60 05 11 00 09 06", "SDO", 3, "answers: abort 6041h:5: 06090011h, there is no such sub-index"),
    (0x603, "80 41 60 00 00 00 04 05", "SDO", 3, "gives up: abort 6041h:0 Statusword: 05040000h, it took too long"),
    (0x583, "41 08 10 00 0C 00 00 00", "SDO", 3, "is 1008h:0 Manufacturer device name: segments of 12 bytes follow"),
    (0x603, "60 00 00 00 00 00 00 00", "SDO", 3, "next segment"),
    (0x583, "0D 68 00 00 00 00 00 00", "SDO", 3, "segment 68 'h', the last"),
    (0x603, "A0 41 60 00 00 00 00 00", "SDO", 3, "block transfer, command A0h"),
    (0x603, "40", "SDO", 3, "malformed"),
    (0x583, "43 18 10 01 78 56 34 12", "SDO", 3, "is 1018h:1 Identity object.Vendor-ID = 12345678h"),
    (0x642, "40 18 10 01 00 00 00 00", "SDO", 66, "read 1018h:1"),
    (0x5C2, "43 18 10 01 78 56 34 12", "SDO", 66, "is 1018h:1 = 78 56 34 12"),
    (0x1C2, "00", "TPDO1", 66, "its mapping is not known"),
    (0x342, "00", "RPDO2", 66, "its mapping is not known"),
    (0x77F, "00", "heartbeat", 127, "boot-up"),
    (0x012, "00", "?", None, ""),
]


@pytest.mark.parametrize(("identifier", "data", "kind", "node", "text"), GOLDEN)
def test_golden_frames(book, identifier, data, kind, node, text):
    line = describe(frame(identifier, data), book)
    assert (line.kind, line.node, line.text) == (kind, node, text)


def test_a_pdo_is_told_by_the_mapping_of_the_data_sheet(book):
    line = describe(frame(0x183, "37 02 00 10 00 00 F6 FF"), book)
    assert (line.kind, line.node) == ("TPDO1", 3)
    assert line.text == "Statusword 0237h (operation enabled), Position actual value 4096, Torque actual value -10"


def test_a_pdo_that_is_too_short_is_malformed(book):
    assert describe(frame(0x183, "37 02"), book).text == "malformed: 2 bytes in place of 8"


def test_a_mapping_that_a_master_writes_is_learnt_when_the_node_took_it(book):
    before = describe(frame(0x183, "37 02 00 10 00 00 F6 FF"), book)
    for request in ("2F 00 1A 00 00 00 00 00", "23 00 1A 01 20 00 6C 60", "2F 00 1A 00 01 00 00 00"):
        book.learn(frame(0x603, request))
    assert describe(frame(0x183, "37 02 00 10 00 00 F6 FF"), book) == before
    for request in ("2F 00 1A 00 00 00 00 00", "23 00 1A 01 20 00 6C 60", "2F 00 1A 00 01 00 00 00"):
        book.learn(frame(0x603, request))
        book.learn(frame(0x583, "60 " + request[3:11] + " 00 00 00 00"))
    assert describe(frame(0x183, "18 FC FF FF"), book).text == "Velocity actual value -1000"


def test_a_mapping_that_is_read_is_learnt_even_of_an_unknown_node():
    book = Book()
    for answer in ("43 00 18 01 85 01 00 00", "4F 00 1A 00 01 00 00 00", "43 00 1A 01 10 00 41 60"):
        book.learn(frame(0x585, answer))
    line = describe(frame(0x185, "37 02"), book)
    assert (line.kind, line.text) == ("TPDO1", "6041h:0 37 02")


def test_what_the_driver_maps_takes_precedence(book):
    book.carry(11, "TPDO1", 0x18B, (MappedObject(0x6150, 1, 8), MappedObject(0x9130, 1, 32)))
    text = describe(frame(0x18B, "04 39 30 00 00"), book).text
    assert text.endswith("12345") and " 4, " in text


def test_frames_that_are_not_canopen_are_told_by_who_knows_them(book):
    for identifier in (0x005, EXTENDED | 0x1F005):
        book.explain(identifier, "MIT", lambda data: (5, f"{len(data)} bytes"))
    assert describe(frame(0x005, "00 01"), book).text == "2 bytes"
    assert describe(frame(0x1F005, "00", is_extended=True), book).node == 5
    assert describe(frame(0x1F006, "00", is_extended=True), book).kind == "?"


MIXED = {
    "robot": "mixed",
    "signals": {"joint_position": {"unit": "rad", "elements": ["elbow", "wrist", "knee", "hip"]}},
    "command": {"signal": "joint_position"},
    "limits": {"joint_position": {"low": -1.5, "high": 1.5, "rate": 2}},
    "buses": {"can0": {"interface": "virtual", "channel": "decode_mixed"}},
    "rates": {"hal": 100},
    "kinds": {
        "damiao": {"driver": "mit", "settings": {"motor": "DM4340", "stiffness": 40, "damping": 1.5}},
        "odrive": {"driver": "odrive", "settings": {"dbc": "dbc/odrive_cansimple.dbc", "gear": 8}},
        "servo": {
            "driver": "cia402",
            "settings": {"eds": "eds/servo_drive.eds", "counts_per_turn": 4096, "gear": 50},
        },
    },
    "devices": {
        "elbow": {"kind": "damiao", "bus": "can0", "node": 4, "element": "joint_position.elbow"},
        "knee": {
            "kind": "damiao", "bus": "can0", "node": 6, "element": "joint_position.knee",
            "settings": {"master_id": 0x14},
        },
        "wrist": {"kind": "odrive", "bus": "can0", "node": 9, "element": "joint_position.wrist"},
        "hip": {"kind": "servo", "bus": "can0", "node": 5, "element": "joint_position.hip"},
    },
    "folder": EDS.parent,
}  # fmt: skip


@pytest.mark.parametrize(
    ("identifier", "data", "kind", "node", "text"),
    [
        (0x004, "FF FF FF FF FF FF FF FC", "MIT", 4, "enter"),
        (0x004, "7F FF 7F F0 00 00 07 FF", "MIT", 4, "go to -0.0001907 rad at -0.002442 rad/s with 0 N m/rad"),
        (0x004, "7F FF", "MIT", 4, "malformed"),
        (0x014, "14 80 00 7F F7 FF 1E 1E", "MIT", 4, "at 0.0001907 rad, -0.002442 rad/s"),
        (0x014, "D6 80 00 7F F7 FF 1E 1E", "MIT", 6, "30 degrees Celsius, state Dh"),
        (0x014, "17 80 00 7F F7 FF 1E 1E", "MIT", None, "of drive 7, which is not in the robot file"),
        (0x121, "00 00 00 00 08 00 00 01", "DBC", 9, "Heartbeat: Axis_Error NONE, Axis_State CLOSED_LOOP_CONTROL"),
        (0x129, "00 00 80 3F 00 00 00 BF", "DBC", 9, "Get_Encoder_Estimates: Pos_Estimate 1, Vel_Estimate -0.5"),
        (0x129, "00 00", "DBC", 9, "Get_Encoder_Estimates"),
        (0x185, "37 02 00 10 00 00", "TPDO1", 5, "Statusword 0237h (operation enabled), Position actual value 4096"),
        (0x205, "0F 00 FF FF FF FF", "RPDO1", 5, "Controlword 000Fh, Target position -1"),
        (0x77F, "05", "heartbeat", 127, "operational"),
    ],
)
def test_a_robot_file_tells_what_the_frames_of_its_devices_mean(identifier, data, kind, node, text):
    book = books(RobotConfig.model_validate(MIXED))["can0"]
    line = describe(frame(identifier, data), book)
    assert (line.kind, line.node) == (kind, node)
    assert text in line.text
    assert book.names[127] == "HAL"


def test_remote_and_error_frames():
    book = Book()
    assert describe(frame(0x703, is_remote=True), book).kind == "remote"
    assert describe(frame(0x40, "00" * 8, is_error=True), book).text.startswith("The controller is bus-off.")
    assert describe(frame(0x04, "00 30" + "00" * 6, is_error=True), book).text.startswith(
        "The controller is error passive."
    )


@pytest.mark.parametrize("data", ["", "FF", "00" * 4, "FF" * 8, "80" * 8, "41 00 1A 00 FF FF FF FF"])
def test_no_frame_raises(book, data):
    for identifier in range(0x800):
        one = frame(identifier, data)
        book.learn(one)
        assert describe(one, book).kind


def test_an_upload_in_segments():
    upload = Upload(0x1008, 0)
    assert upload.request == bytes.fromhex("4008100000000000")
    assert not upload.answer(bytes.fromhex("4309100041424344"))  # another object
    assert upload.answer(bytes.fromhex("410810000A000000"))
    assert upload.request == bytes.fromhex("6000000000000000")
    assert upload.answer(b"\x00elbow d")
    assert upload.request == bytes.fromhex("7000000000000000")
    assert not upload.answer(b"\x00elbow d")  # the toggle bit is of the segment before
    assert upload.answer(b"\x19rive\0\0\0")
    assert upload.value == b"elbow drive"[: len(upload.value)] and upload.is_done


def test_an_upload_that_is_refused_or_never_ends():
    upload = Upload(0x1018, 4)
    assert upload.answer(bytes.fromhex("8018100411000906"))
    assert upload.refused == "06090011h, there is no such sub-index"
    endless = Upload(0x1008, 0)
    endless.answer(bytes.fromhex("4108100000000000"))
    toggle = 0
    while not endless.is_done:
        assert endless.answer(bytes([toggle << 4]) + b"x" * 7)
        toggle ^= 1
    assert "does not end" in endless.refused


def test_a_frame_of_can_fd_under_an_identifier_of_canopen_is_none_of_canopen(book):
    """A heartbeat, a PDO and an SDO request are classic frames."""
    for identifier in (0x703, 0x183, 0x603):
        assert describe(frame(identifier, "05" * 8, is_fd=True), book).kind == "CAN FD"
    before = dict(book.pdos)
    book.learn(frame(0x603, "23 00 1A 01 20 00 64 60", is_fd=True))
    assert book.pdos == before
