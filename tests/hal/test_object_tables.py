"""Objects, identifiers and codes as the standards print them: CiA 301, 402-2, 401, 404, 406, and Linux' can/error.h."""

import pytest

from hal.protocols import analog, cia301, cia402, cia406, error_frames, sdo
from hal.protocols.error_frames import Controller, error_frame

DRIVE = {
    "ABORT_CONNECTION": "6007h:0 int16",
    "CONTROLWORD": "6040h:0 uint16",
    "STATUSWORD": "6041h:0 uint16",
    "QUICK_STOP_OPTION": "605Ah:0 int16",
    "MODE_OF_OPERATION": "6060h:0 int8",
    "MODE_DISPLAY": "6061h:0 int8",
    "POSITION": "6064h:0 int32",
    "FOLLOWING_ERROR_WINDOW": "6065h:0 uint32",
    "VELOCITY": "606Ch:0 int32",
    "TARGET_TORQUE": "6071h:0 int16",
    "MAX_TORQUE": "6072h:0 uint16",
    "RATED_TORQUE": "6076h:0 uint32",
    "TORQUE": "6077h:0 int16",
    "TARGET_POSITION": "607Ah:0 int32",
    "HOME_OFFSET": "607Ch:0 int32",
    "LOWEST_POSITION": "607Dh:1 int32",
    "HIGHEST_POSITION": "607Dh:2 int32",
    "MAX_PROFILE_VELOCITY": "607Fh:0 uint32",
    "MAX_MOTOR_SPEED": "6080h:0 uint32",
    "PROFILE_VELOCITY": "6081h:0 uint32",
    "PROFILE_ACCELERATION": "6083h:0 uint32",
    "PROFILE_DECELERATION": "6084h:0 uint32",
    "HOMING_METHOD": "6098h:0 int8",
    "HOMING_SPEED_SWITCH": "6099h:1 uint32",
    "HOMING_SPEED_ZERO": "6099h:2 uint32",
    "HOMING_ACCELERATION": "609Ah:0 uint32",
    "VELOCITY_UNIT": "60A9h:0 uint32",
    "INTERPOLATION_SUBMODE": "60C0h:0 int16",
    "INTERPOLATION_DATA": "60C1h:1 int32",
    "INTERPOLATION_PERIOD": "60C2h:1 uint8",
    "INTERPOLATION_INDEX": "60C2h:2 int8",
    "FOLLOWING_ERROR": "60F4h:0 int32",
    "TARGET_VELOCITY": "60FFh:0 int32",
    "SUPPORTED_MODES": "6502h:0 uint32",
}
ENCODER = {
    "OPERATING_PARAMETERS": "6000h:0 uint16",
    "UNITS_PER_TURN": "6001h:0 uint32",
    "TOTAL_UNITS": "6002h:0 uint32",
    "POSITION": "6004h:0 uint32",
    "SPEED": "6030h:1 int16",
    "SPEED_MULTIPLIER": "6031h:3 uint16",
    "SPEED_DIVIDER": "6031h:4 uint16",
    "PHYSICAL_PER_TURN": "6501h:0 uint32",
    "PHYSICAL_TURNS": "6502h:0 uint16",
    "ALARMS": "6503h:0 uint16",
    "WARNINGS": "6505h:0 uint16",
}


@pytest.mark.parametrize(("protocol", "table"), [(cia402, DRIVE), (cia406, ENCODER)], ids=["cia402", "cia406"])
def test_objects_of_a_profile(protocol, table):
    objects = {name: item for name, item in vars(protocol).items() if isinstance(item, cia301.MappedObject)}
    assert objects == {name: cia301.mapped(*text.split()) for name, text in table.items()}


@pytest.mark.parametrize(
    ("text", "entry", "layout"),
    [
        ("6041h:0 uint16", 0x60410010, "H"),
        ("6060h int8", 0x60600008, "b"),
        ("0x607D:2 int32", 0x607D0220, "i"),
        ("6099:1 uint32", 0x60990120, "I"),
        ("6130h:255 float32", 0x6130FF20, "f"),
        ("2000h:1 float64", 0x20000140, "d"),
        ("2000h:1 int64", 0x20000140, "q"),
        ("2000h:1 uint64", 0x20000140, "Q"),
        ("2000h:1 uint8", 0x20000108, "B"),
        ("2000h:1 int16", 0x20000110, "h"),
    ],
)
def test_an_object_as_a_robot_file_writes_it(text, entry, layout):
    item = cia301.mapped(*text.split())
    assert (item.entry, item.format) == (entry, layout)


@pytest.mark.parametrize("place", ["6064h:256", "664h", "6064h:", "6064h:1:2", "elbow"])
def test_what_is_no_object(place):
    with pytest.raises(ValueError, match="not an object"):
        cia301.mapped(place, "int16")


def test_identifiers_and_communication_objects():
    """CiA 301: tables 38 and 39 (identifiers), 7.5.2 (objects), table 31 (transmission types), 7.2.8 (NMT)."""
    assert (cia301.NMT, cia301.SYNC, cia301.EMERGENCY, cia301.HEARTBEAT) == (0x000, 0x080, 0x080, 0x700)
    assert (cia301.TPDO1, cia301.RPDO1, cia301.SDO_ANSWER, cia301.SDO_REQUEST) == (0x180, 0x200, 0x580, 0x600)
    assert (cia301.DEVICE_TYPE, cia301.IDENTITY) == (0x1000, 0x1018)
    assert (cia301.CONSUMER_HEARTBEAT, cia301.PRODUCER_HEARTBEAT) == (0x1016, 0x1017)
    assert (cia301.RPDO_PARAMETERS, cia301.RPDO_MAPPING) == (0x1400, 0x1600)
    assert (cia301.TPDO_PARAMETERS, cia301.TPDO_MAPPING) == (0x1800, 0x1A00)
    assert (cia301.ERROR_BEHAVIOUR, cia301.BECOME_PRE_OPERATIONAL) == (0x1029, 0)
    assert (cia301.SYNCHRONOUS, cia301.LAST_SYNCHRONOUS, cia301.EVENT_DRIVEN) == (1, 240, (254, 255))
    assert (cia301.PDO_INVALID, cia301.PDO_PER_DIRECTION, cia301.PDO_SIZE) == (0x8000_0000, 4, 8)
    assert sorted(cia301.NmtCommand) == [0x01, 0x02, 0x80, 0x81, 0x82]
    assert sorted(cia301.NmtState) == [0x00, 0x04, 0x05, 0x7F]


def test_bits_of_controlword_and_statusword():
    """CiA 402-2: the bits that all modes share, those of profile position, interpolated position and homing."""
    words = (cia402.DISABLE_VOLTAGE, cia402.QUICK_STOP, cia402.SHUTDOWN, cia402.SWITCH_ON, cia402.ENABLE_OPERATION)
    assert words == (0x00, 0x02, 0x06, 0x07, 0x0F)
    assert (cia402.FAULT_RESET, cia402.NEW_SET_POINT, cia402.CHANGE_AT_ONCE, cia402.START_HOMING) == (128, 16, 32, 16)
    assert (cia402.WARNING, cia402.REMOTE, cia402.TARGET_REACHED) == (0x0080, 0x0200, 0x0400)
    assert (cia402.SET_POINT_TAKEN, cia402.HOMING_ATTAINED, cia402.HOMING_ERROR) == (0x1000, 0x1000, 0x2000)
    assert (cia402.ABORT_QUICK_STOP, cia402.QUICK_STOP_AND_OFF, cia402.PROFILE) == (3, 2, 402)
    assert (cia402.INTERPOLATE, cia402.LINEAR) == (0x0010, 0)
    assert sorted(cia402.OperationMode) == [1, 6, 7, 8, 9, 10]


@pytest.mark.parametrize(
    ("mode", "bit", "name"),
    [
        (1, 0, "profile position"),
        (2, 1, "velocity"),
        (3, 2, "profile velocity"),
        (4, 3, "profile torque"),
        (6, 5, "homing"),
        (7, 6, "interpolated position"),
        (8, 7, "cyclic synchronous position"),
        (9, 8, "cyclic synchronous velocity"),
        (10, 9, "cyclic synchronous torque"),
    ],
)
def test_modes_of_operation_and_their_bits_in_6502h(mode, bit, name):
    assert cia402.describe_mode(mode) == name
    assert cia402.describe_modes(1 << bit) == name
    assert cia402.supports(1 << bit, mode)
    assert not cia402.supports(~(1 << bit) & 0x3FF, mode)


def test_letting_a_drive_go():
    """CiA 402-2, transitions: shutdown (6), disable operation (5), disable voltage (9 and 12)."""
    state = cia402.State
    assert cia402.towards_disabled(state.OPERATION_ENABLED, slow_down=True) == 0x07
    assert [cia402.towards_disabled(s) for s in (state.SWITCHED_ON, state.READY_TO_SWITCH_ON)] == [0x06, 0x06]
    assert cia402.towards_disabled(state.SWITCHED_ON, slow_down=True) == 0x06
    assert [cia402.towards_disabled(s) for s in (state.SWITCH_ON_DISABLED, state.FAULT)] == [0x00, 0x00]
    assert cia402.towards_enabled(state.QUICK_STOP_ACTIVE) == 0x00


@pytest.mark.parametrize(
    ("code", "per_second", "is_turns"),
    [
        (0x0C_B4_03_00, 1e12, True),
        (0xF4_B5_47_00, 1e-12 / 60, False),
        (0x0D_B4_03_00, None, True),
        (0xF3_B4_03_00, None, True),
        (0x01_B5_03_00, 10.0, False),
    ],
)
def test_powers_of_ten_of_velocity_units(code, per_second, is_turns):
    unit = cia402.velocity_unit(code)
    expected = None if per_second is None else (pytest.approx(per_second), is_turns)
    assert (unit and (unit.per_second, unit.is_turns)) == expected


def test_units_of_velocities_in_counts_per_second():
    counts = {name: unit.counts_per_second(6000) for name, unit in cia402.VELOCITY_UNITS.items()}
    assert counts == pytest.approx({"counts/s": 1.0, "rps": 6000, "rpm": 100, "0.1 rpm": 10, "mrpm": 0.1})


ABORT_CODES = """
    05030000 05040000 05040001 05040005 06010000 06010001 06010002 06020000 06040041 06040042 06040043 06070010
    06070012 06070013 06090011 06090030 06090031 06090032 08000000 08000020 08000022
"""


def test_abort_codes():
    """CiA 301, table 22."""
    assert {f"{code:08X}" for code in sdo.ABORTS} == set(ABORT_CODES.split())
    assert sdo.describe_abort(0x0604_0041) == "06040041h, it cannot be mapped"
    assert sdo.describe_abort(0x0601_0002) == "06010002h, it is read only"
    assert sdo.describe_abort(0x0504_0002) == "05040002h, see CiA 301, table 22"


@pytest.mark.parametrize(
    ("answer", "value"),
    [
        ("4F 60 60 00 11 22 33 44", "11"),
        ("4B 60 60 00 11 22 33 44", "11 22"),
        ("47 60 60 00 11 22 33 44", "11 22 33"),
        ("43 60 60 00 11 22 33 44", "11 22 33 44"),
        ("42 60 60 00 11 22 33 44", "11 22 33 44"),  # no size indicated
    ],
)
def test_the_size_of_an_expedited_answer(answer, value):
    """CiA 301, 7.2.4.3.6: bit 1 expedited, bit 0 size indicated, bits 2 and 3 bytes without data."""
    assert sdo.expedited(bytes.fromhex(answer)) == bytes.fromhex(value)
    upload = sdo.Upload(0x6060, 0)
    assert upload.request == bytes.fromhex("40 60 60 00 00 00 00 00")
    assert upload.answer(bytes.fromhex(answer))
    assert (upload.value, upload.refused, upload.is_done) == (bytes.fromhex(value), "", True)
    assert not upload.answer(bytes.fromhex(answer))


@pytest.mark.parametrize("count", range(1, 8))
def test_the_size_of_the_last_segment(count):
    """CiA 301, 7.2.4.3.7: bit 0 last segment, bits 1 to 3 bytes without data, bit 4 toggle."""
    upload = sdo.Upload(0x1008, 0)
    assert upload.answer(bytes.fromhex("41 08 10 00 0E 00 00 00"))
    assert upload.request == bytes.fromhex("60 00 00 00 00 00 00 00")
    assert not upload.answer(bytes.fromhex("10 00 00 00 00 00 00 00"))  # the toggle bit of the second segment
    assert not upload.answer(bytes.fromhex("60 00 00 00 00 00 00 00"))  # the answer to a download
    assert upload.answer(b"\x00abcdefg")
    assert not upload.is_done
    assert upload.request == bytes.fromhex("70 00 00 00 00 00 00 00")
    assert not upload.answer(b"\x00abcdefg")
    assert upload.answer(bytes([0x11 | (7 - count) << 1]) + b"hijklmn")
    assert upload.value == b"abcdefghijklmn"[: 7 + count]


def test_an_upload_of_more_than_two_segments_toggles_and_ends_at_4096_bytes():
    upload = sdo.Upload(0x1008, 0)
    upload.answer(bytes.fromhex("41 08 10 00 00 00 00 00"))
    for number in range(586):
        assert not upload.is_done
        assert upload.request[0] == (0x60, 0x70)[number % 2]
        assert upload.answer(bytes([number % 2 << 4]) + bytes(7))
    assert "4096 bytes" in upload.refused  # 586 * 7 = 4102
    assert upload.value is None


def test_answers_to_other_requests_are_not_taken():
    upload = sdo.Upload(0x1018, 4)
    for answer in ("43 18 10 03", "43 17 10 04", "43 18 11 04", "60 18 10 04", "80 18 10 03", "00 18 10 04"):
        assert not upload.answer(bytes.fromhex(answer) + bytes(4))
    assert not upload.answer(bytes.fromhex("43 18 10 04 00 00 00"))
    assert not upload.is_done
    assert upload.answer(bytes.fromhex("80 18 10 04 00 00 02 06"))
    assert (upload.value, upload.refused) == (None, "06020000h, there is no such object")


FAMILIES = {
    0x10: "generic error",
    0x20: "current",
    0x21: "current, device input side",
    0x22: "current inside the device",
    0x23: "current, device output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x70: "additional modules",
    0x73: "sensor",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol",
    0x84: "velocity",
    0x86: "position",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}
"""Error classes by their upper byte (CiA 301, table 26; CiA 402-1 for 73h, 84h and 86h)."""
CODES = {
    0x8110: "CAN overrun",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard or heartbeat error",
    0x8140: "recovered from bus-off",
    0x8150: "CAN identifier collision",
    0x8210: "PDO not processed: length error",
    0x8220: "PDO length exceeded",
    0x8611: "following error",
}


def test_every_emergency_code_in_words():
    for code in range(0x10000):
        high = code >> 8
        family = FAMILIES.get(high) or FAMILIES.get(high & 0xF0, "unknown family")
        exact = f": {CODES[code]}" if code in CODES else ""
        assert cia301.describe_emergency(code) == f"{family}{exact} ({code:04X}h)"


@pytest.mark.parametrize(
    ("bit", "name"),
    [
        (0, "generic"),
        (1, "current"),
        (2, "voltage"),
        (3, "temperature"),
        (4, "communication"),
        (5, "device profile"),
        (6, "reserved"),
        (7, "manufacturer"),
    ],
)
def test_bits_of_the_error_register(bit, name):
    assert cia301.describe_emergency(0x1000, 1 << bit, bytes(5)) == f"generic error (1000h) (register: {name})"


def test_bits_of_encoders_and_cells():
    """CiA 406: 6000h bit 2, 6503h, 6505h. CiA 404: 6150h and the signature of 6125h."""
    assert (cia406.PROFILE, cia406.SCALING_ON) == (406, 0x0004)
    alarms = ["position error", "commissioning diagnostic failed"]
    assert [cia406.describe_alarms(1 << bit) for bit in range(3)] == [*alarms, "alarms 0004h"]
    assert cia406.describe_alarms(0x8003) == "position error, commissioning diagnostic failed, alarms 8000h"
    assert [cia406.describe_warnings(1 << bit) for bit in range(7)] == [
        "frequency exceeded",
        "light control reserve reached",
        "watchdog status not good",
        "operating time limit exceeded",
        "battery charge too low",
        "reference point not reached",
        "warnings 0040h",
    ]
    assert [cia406.describe_alarms(0), cia406.describe_warnings(0)] == ["", ""]
    cell = ["value not valid", "positive overload", "negative overload", "status 08h"]
    assert [analog.describe_status(1 << bit) for bit in range(4)] == cell
    assert analog.ZERO.to_bytes(4, "little") == b"zero"


def test_objects_of_inputs_and_cells():
    assert (analog.INPUT_PROFILE, analog.CELL_PROFILE) == (401, 404)
    assert {name: str(item) for name, item in analog.INPUTS.items()} == {
        "int16": "6401h:0",
        "int32": "6402h:0",
        "float32": "6403h:0",
    }
    assert [(item.bits, item.kind) for item in analog.INPUTS.values()] == [
        (16, "signed"),
        (32, "signed"),
        (32, "float"),
    ]
    assert cia301.mapped("6423h", "uint8") == analog.INTERRUPT_ENABLE
    assert cia301.mapped("6150h", "uint8") == analog.STATUS
    assert (analog.OFFSET, analog.AUTOZERO, analog.UNIT_CODE, analog.DIGITS) == (0x6124, 0x6125, 0x6131, 0x6132)
    forms = {name: (form.value, form.has_unit, form.has_digits, form.status) for name, form in analog.FORMS.items()}
    assert forms == {
        "float32": (cia301.mapped("6130h", "float32"), True, False, analog.STATUS),
        "int16": (cia301.mapped("7130h", "int16"), True, True, analog.STATUS),
        "int32": (cia301.mapped("9130h", "int32"), True, True, analog.STATUS),
        "counts16": (cia301.mapped("7100h", "int16"), False, False, analog.STATUS),
        "counts32": (cia301.mapped("9100h", "int32"), False, False, analog.STATUS),
    }


def test_units_in_si():
    """Newton, newton metre and pascal; a kilogram weighs 9.80665 N (standard gravity)."""
    units = {name: (unit.quantity, unit.scale) for name, unit in analog.UNITS.items()}
    assert units == {
        "N": ("force", 1.0),
        "mN": ("force", 0.001),
        "kN": ("force", 1000.0),
        "kg": ("force", 9.80665),
        "g": ("force", pytest.approx(0.00980665)),
        "N m": ("torque", 1.0),
        "mN m": ("torque", 0.001),
        "kN m": ("torque", 1000.0),
        "Pa": ("pressure", 1.0),
        "kPa": ("pressure", 1000.0),
        "MPa": ("pressure", 1e6),
        "mbar": ("pressure", 100.0),
        "bar": ("pressure", 1e5),
    }


@pytest.mark.parametrize(
    ("code", "scale"),
    [
        (0x18210000, 1e24),
        (0xE8210000, 1e-24),
        (0x19210000, None),
        (0xE7210000, None),
        (0x00210001, None),
        (0x00210100, None),
        (0x00010000, None),
        (0xFF020000, 0.980665),
    ],
)
def test_unit_codes_at_their_ends(code, scale):
    unit = analog.unit(code)
    assert (unit and unit.scale) == (scale if scale is None else pytest.approx(scale))


def test_classes_of_error_frames():
    """can/error.h: CAN_ERR_TX_TIMEOUT to CAN_ERR_CNT."""
    names = "TX_TIMEOUT LOST_ARBITRATION CONTROLLER PROTOCOL TRANSCEIVER NO_ACKNOWLEDGE BUS_OFF BUS_ERROR RESTARTED"
    bits = [getattr(error_frames, name) for name in (*names.split(), "COUNTERS")]
    assert bits == [1 << bit for bit in range(10)]


@pytest.mark.parametrize(
    ("kind", "data", "controller", "words"),
    [
        (0x001, "", None, "could not send a frame in time"),
        (0x002, "0A", None, ""),
        (0x004, "00 01", None, "receive buffer overflowed"),
        (0x004, "00 02", None, "transmit buffer overflowed"),
        (0x004, "00 04", Controller.WARNING, "counts many errors"),
        (0x004, "00 08", Controller.WARNING, "counts many errors"),
        (0x004, "00 10", Controller.PASSIVE, "error passive"),
        (0x004, "00 20", Controller.PASSIVE, "error passive"),
        (0x004, "00 40", Controller.ACTIVE, ""),
        (0x008, "00 00 01", None, "a single bit was wrong"),
        (0x008, "00 00 02", None, "a frame had the wrong form"),
        (0x008, "00 00 04", None, "bit stuffing was wrong"),
        (0x008, "00 00 08", None, "a dominant bit"),
        (0x008, "00 00 10", None, "a recessive bit"),
        (0x008, "00 00 20", None, "overloaded"),
        (0x008, "00 00 40", None, "the protocol was violated"),
        (0x010, "00 00 00 00 07", None, "wires (07h)"),
        (0x020, "", None, "acknowledges"),
        (0x040, "", Controller.OFF, "bus-off"),
        (0x080, "", None, "Frames are disturbed"),
        (0x100, "", Controller.ACTIVE, ""),
        (0x200, "00 00 00 00 00 00 5F 00", Controller.ACTIVE, ""),
        (0x200, "00 00 00 00 00 00 00 60", Controller.WARNING, "counts many errors"),
        (0x200, "00 00 00 00 00 00 7F 00", Controller.WARNING, "counts many errors"),
        (0x200, "00 00 00 00 00 00 00 80", Controller.PASSIVE, "error passive"),
        (0x400, "", None, "class 400h"),
    ],
)
def test_error_frames(kind, data, controller, words):
    frame = error_frame(kind, bytes.fromhex(data))
    assert frame.controller is controller
    assert words in frame.text
    assert bool(words) == bool(frame.text)
    detail = bytes.fromhex(data)
    assert frame.counters == ((detail[6], detail[7]) if kind == 0x200 else None)


def test_counters_of_a_controller_error():
    """can/error.h: bytes 6 and 7 are the counters; older kernels do not set CAN_ERR_CNT."""
    assert error_frame(0x004, bytes.fromhex("00 40 00 00 00 00 01 02")).counters == (1, 2)
    assert error_frame(0x004, bytes.fromhex("00 40 00 00 00 00 00 03")).counters == (0, 3)
    assert error_frame(0x001, bytes.fromhex("00 40 00 00 00 00 01 02")).counters is None
    assert error_frame(0x004, bytes.fromhex("00 00 00 00 00 00 80 00")).controller is None
    assert error_frame(0x204, bytes.fromhex("00 10 00 00 00 00 00 01")).controller is Controller.PASSIVE
