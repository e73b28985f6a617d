"""Frames of CAN FD: their lengths, what a bus and a DBC file make of them, and what a classic bus refuses."""

import struct
import time

import can
import pytest
from hal_bench import description

from hal.clock import SystemClock
from hal.config import BusConfig, RobotConfig
from hal.drivers.can_device import Place
from hal.drivers.dbc.sensor import DbcNode
from hal.drivers.dbc.settings import DbcSettings
from hal.errors import ConfigError
from hal.finding.scan import scan
from hal.finding.tap import Tap
from hal.protocols import dbc
from hal.protocols.can_frames import FD_SIZES, FrameLengths, fd_bits, fd_size, frame_bits
from hal.wire import budget
from hal.wire.bus import Bus, BusState
from simulators.hub import HubServer

FORMATS = 'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN",{},"StandardCAN_FD","ExtendedCAN_FD";'.format(
    ",".join(f'"{number}"' for number in range(2, 14))
)
FILE = f"""VERSION ""
BU_: Node Host
BO_ 256 Wide: 30 Node
 SG_ Low : 0|16@1- (0.5,0) [0|0] "" Host
 SG_ High : 199|32@0- (0.01,-3) [0|0] "" Host
 SG_ Odd : 229|11@0+ (1,0) [0|0] "" Host
BO_ 257 Short: 4 Node
 SG_ Value : 0|32@1- (1,0) [0|0] "" Host
BO_ 258 Plain: 8 Node
 SG_ Value : 0|32@1- (1,0) [0|0] "" Host
BO_ 512 Order: 10 Host
 SG_ Mode : 0|8@1+ (1,0) [0|9] "" Node
 SG_ Target : 48|32@1- (1,0) [0|0] "" Node
BO_ 2566848513 TooLong: 65 Node
 SG_ Value : 0|32@1- (1,0) [0|0] "" Host
{FORMATS}
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 256 14;
BA_ "VFrameFormat" BO_ 257 14;
BA_ "VFrameFormat" BO_ 512 14;
BA_ "VFrameFormat" BO_ 2566848513 15;
"""
SENSOR = {
    "dbc": "wide.dbc",
    "periods": {"Wide": 0.01, "Plain": 0.01},
    "quantities": {"force": {"signal": "Wide.High"}, "other": {"signal": "Plain.Value"}},
    "silent_after": 0.5,
}
DEADLINE = 10.0


@pytest.fixture
def file(tmp_path):
    (tmp_path / "wide.dbc").write_text(FILE)
    return dbc.load(tmp_path / "wide.dbc")


def test_sizes_are_those_of_the_length_code():
    assert FD_SIZES == (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
    assert [fd_size(length) for length in (0, 8, 9, 12, 13, 25, 33, 49, 64)] == [0, 8, 12, 12, 16, 32, 48, 64, 64]
    with pytest.raises(ValueError, match="65 bytes"):
        fd_size(65)


def test_the_data_of_a_long_frame_take_less_time_at_a_higher_bit_rate():
    """A frame of 64 bytes at 1 and 5 Mbit/s takes less than twice as long as a classic one of 8."""
    slow, quick = FrameLengths(1_000_000, 1_000_000), FrameLengths(1_000_000, 5_000_000)
    at_bus, at_data = fd_bits(64)
    assert slow.of(64, False, is_fd=True) == at_bus + at_data
    assert quick.of(64, False, is_fd=True) == pytest.approx(at_bus + at_data / 5)
    assert quick.of(64, False, is_fd=True) < 2 * frame_bits(8) < slow.of(64, False, is_fd=True)
    assert quick.of(8, True, is_fd=False) == frame_bits(8, is_extended=True)


def test_what_a_dbc_file_says_of_its_frames(file):
    kinds = {message.name: (dbc.is_fd(message), dbc.size_of(message)) for message in file.messages}
    assert kinds == {"Wide": (True, 32), "Short": (True, 4), "Plain": (False, 8), "Order": (True, 12)}
    assert "at most 64" in file.left_out["TooLong"]


LONG = """VERSION ""
BU_: Ecu
BO_ 2364540158 Long: 39 Ecu
 SG_ Speed : 0|16@1+ (0.125,0) [0|8000] "rpm" Vector__XXX
BO_ 2364540159 Brief: 8 Ecu
 SG_ Speed : 0|16@1+ (0.125,0) [0|8000] "rpm" Vector__XXX
"""
OLD_FORMATS = 'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'


@pytest.mark.parametrize(
    ("attributes", "reason"),
    [
        ("", ""),
        (f'{OLD_FORMATS}BA_DEF_DEF_ "VFrameFormat" "J1939PG";\n', "transport protocol of J1939"),
        (
            'BA_DEF_ "ProtocolType" STRING ;\nBA_DEF_DEF_ "ProtocolType" "";\nBA_ "ProtocolType" "J1939";\n',
            "transport protocol of J1939",
        ),
        (f'{OLD_FORMATS}BA_DEF_DEF_ "VFrameFormat" "ExtendedCAN";\n', "not of CAN FD by its VFrameFormat"),
    ],
)
def test_a_long_message_is_one_of_can_fd_only_if_the_file_does_not_say_otherwise(tmp_path, attributes, reason):
    """A message of J1939 with more than 8 bytes comes in several classic frames."""
    (tmp_path / "long.dbc").write_text(LONG + attributes)
    file = dbc.load(tmp_path / "long.dbc")
    assert reason in file.left_out.get("Long", "")
    assert {message.name: dbc.is_fd(message) for message in file.messages} == (
        {"Brief": False} if reason else {"Long": True, "Brief": False}
    )


@pytest.mark.parametrize("names", [("High",), ("High", "Odd"), ("Low", "High", "Odd")])
def test_signals_behind_the_eighth_byte(file, names):
    """The three selections are read by `struct`, by shifts, and by cantools."""
    reader = dbc.SignalReader(file.message("Wide"), names)
    data = bytearray(32)
    struct.pack_into("<h", data, 0, -7)
    struct.pack_into(">i", data, 24, -123456)
    struct.pack_into(">H", data, 28, 1234 << 3)  # the lowest bit is bit 3 of byte 29
    expected = {"Low": -7, "High": -123456, "Odd": 1234}
    assert dict(zip(reader.names, reader.read(data), strict=True)) == {name: expected[name] for name in names}
    assert reader.size == 32


def test_a_written_frame_is_filled_up_with_zeros(file):
    writer = dbc.Writer(file, file.message("Order"), {"Mode": 3.0}, varying="Target")
    writer.write(-2.0)
    assert bytes(writer.data) == bytes([3, 0, 0, 0, 0, 0]) + struct.pack("<i", -2) + bytes(2)


def fd_bus(channel, **changes):
    return Bus("can0", BusConfig(interface="hub", channel=channel, data_bitrate=5_000_000, **changes), SystemClock())


def sensor(folder, bus):
    (folder / "wide.dbc").write_text(FILE)
    elements = {"force": "wire_force.one", "other": "wire_force.two"}
    return DbcNode(Place("one", elements, bus, 0, folder, 200.0), DbcSettings.model_validate(SENSOR))


def until(condition, what):
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.005)


def wide(raw, size=32):
    data = bytearray(size)
    struct.pack_into(">i", data, 24, raw)
    return can.Message(arbitration_id=256, data=data, is_extended_id=False, is_fd=True, bitrate_switch=True)


def test_both_kinds_of_frames_arrive_on_one_bus(tmp_path):
    """A frame with another number of bytes than the file says is malformed, and no value."""
    channel = str(tmp_path / "can")
    bus = fd_bus(channel)
    device = sensor(tmp_path, bus)
    device.is_commissioned = True
    with HubServer(channel, 1_000_000, 5_000_000), can.Bus(interface="hub", channel=channel) as peer:
        bus.open()
        until(lambda: bus.counters["opened"], "the interface")
        peer.send(wide(50_300))
        peer.send(can.Message(arbitration_id=258, data=struct.pack("<ii", 42, 0), is_extended_id=False))
        until(lambda: device._values.tolist() == [pytest.approx(500.0), 42.0], "the values")
        peer.send(wide(99, size=48))
        until(lambda: device._counters["malformed"] == 1, "the malformed frame")
        assert device._values.tolist() == [pytest.approx(500.0), 42.0]
        assert bus.counters["ignored"] == 0
        bus.close()


def test_a_frame_goes_out_as_one_of_can_fd(tmp_path):
    channel = str(tmp_path / "can")
    bus = fd_bus(channel)
    with HubServer(channel, None, 5_000_000), can.Bus(interface="hub", channel=channel) as peer:
        bus.open()
        until(lambda: bus.counters["opened"], "the interface")
        assert bus.send(wide(1))
        assert not bus.send(can.Message(arbitration_id=1, data=bytes(10), is_fd=True, is_extended_id=False))
        assert not bus.send(can.Message(arbitration_id=1, data=bytes(9), is_extended_id=False))
        message = peer.recv(DEADLINE)
        assert (message.is_fd, message.bitrate_switch, len(message.data)) == (True, True, 32)
        bus.close()


def test_a_classic_bus_ignores_frames_of_can_fd_and_sends_none(tmp_path):
    """Its HAL does not fail when a sensor is set to the wrong kind of frames, and says so by a counter."""
    channel = f"classic {tmp_path}"
    bus = Bus("can0", BusConfig(interface="virtual", channel=channel), SystemClock())
    with can.Bus(interface="virtual", channel=channel) as peer:
        bus.open()
        peer.send(wide(5))
        until(lambda: bus.counters["ignored"] == 1, "the ignored frame")
        assert not bus.send(wide(5))
        assert bus.counters["send_failures"] == 1 and bus.state is not BusState.BUS_OFF
        bus.close()


def test_a_length_that_there_is_not_is_ignored_and_stops_nothing(tmp_path):
    """An interface may pass on anything, and its thread must go on."""
    config = BusConfig(interface="virtual", channel=f"odd {tmp_path}", data_bitrate=5_000_000)
    bus, heard = Bus("can0", config, SystemClock()), []
    bus.subscribe(256, lambda data, received: heard.append(len(data)))
    with can.Bus(interface="virtual", channel=config.channel) as peer, Tap("can0", config) as tap:
        bus.open()
        for size in (9, 65):
            peer.send(can.Message(arbitration_id=256, data=bytes(size), is_fd=True, is_extended_id=False))
        peer.send(wide(5))
        until(lambda: heard, "the sound frame")
        assert heard == [32]
        assert (bus.counters["ignored"], bus.counters["opened"], bus.counters["failures"]) == (2, 1, 0)
        assert scan(tap, listen=0.1, ask=False).unknown == {256: pytest.approx(10.0)}
        bus.close()


def test_a_hub_without_can_fd_refuses_such_frames(tmp_path):
    channel = str(tmp_path / "can")
    with (
        HubServer(channel),
        can.Bus(interface="hub", channel=channel) as peer,
        pytest.raises(can.CanOperationError, match="data_bitrate"),
    ):
        peer.send(wide(5))


def test_a_device_that_needs_can_fd_is_refused_on_a_classic_bus(tmp_path):
    bus = Bus("can0", BusConfig(interface="virtual", channel="classic"), SystemClock())
    with pytest.raises(ConfigError, match=r"Wide is a frame of CAN FD.*buses\.can0\.data_bitrate"):
        sensor(tmp_path, bus)


def test_the_budget_counts_the_frames_as_long_as_they_are(tmp_path):
    (tmp_path / "wide.dbc").write_text(FILE)
    settings = {**SENSOR, "quantities": {"force": {"signal": "Wide.High"}}, "periods": {"Wide": "cycle", "Plain": 0.02}}
    body = description(rates={"hal": 200}, limits={}, folder=tmp_path)
    body["signals"] = {"joint_position": {"unit": "rad", "elements": ["one"]}}
    body["signals"]["wire_force"] = {"unit": "N", "elements": ["one"]}
    body["command"] = {"signal": "joint_position"}
    body["buses"] = {"can0": {"channel": "x", "bitrate": 1_000_000, "data_bitrate": 4_000_000}}
    body["kinds"] = {
        "cell": {"driver": "dbc", "settings": settings},
        "motor": {"driver": "mit", "settings": {"motor": "DM4310", "stiffness": 40.0, "damping": 2.0, "ramp": 0.1}},
    }
    body["devices"] = {
        "cell": {"kind": "cell", "bus": "can0", "node": 1, "element": "wire_force.one"},
        "motor": {"kind": "motor", "bus": "can0", "node": 90, "element": "joint_position.one"},
    }
    (only,) = budget.budgets(RobotConfig.model_validate(body))
    at_bus, at_data = fd_bits(32)
    assert only.bits == pytest.approx(at_bus + at_data / 4 + 2 * frame_bits(8))
    assert only.beside == pytest.approx(50 * frame_bits(8))


def test_data_that_are_slower_than_the_bus_are_refused():
    with pytest.raises(ValueError, match="data_bitrate is 500000, below bitrate"):
        BusConfig(channel="can0", bitrate=1_000_000, data_bitrate=500_000)
