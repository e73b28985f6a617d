"""Frames of CiA 301 and CiA 402 written out by hand from the standards' tables; driver and simulated drive must both
speak them, and neither is asked what they should be."""

import threading

import can
import pytest
from drive_bench import JointBench
from hal_bench import ROBOTS

from hal.clock import SystemClock
from hal.commissioning.sdo_client import SdoClient
from hal.config import BusConfig
from hal.drivers.canopen.node import data_sheet
from hal.errors import DeviceRefused
from hal.protocols import cia301, cia402
from hal.protocols.cia402 import State
from hal.wire.bus import Bus
from simulators.nodes.cia402 import states as drive_states

NODE = 5
REQUEST, ANSWER = 0x605, 0x585


class Wire:
    """Everything on the bus of a bench, in order."""

    def __init__(self, bench):
        self._bus = can.Bus(interface="virtual", channel=bench.config.buses["can0"].channel)
        self.bench = bench

    def frames(self, *identifiers):
        found = []
        while (message := self._bus.recv(0)) is not None:
            if not identifiers or message.arbitration_id in identifiers:
                found.append((message.arbitration_id, message.data.hex(" ").upper()))
        return found

    def ask(self, identifier, text, answer):
        """What the simulated node answers to bytes written by hand."""
        self.frames()
        self._bus.send(can.Message(arbitration_id=identifier, data=bytes.fromhex(text), is_extended_id=False))
        self.bench.rig.step(0.0)
        return [data for found, data in self.frames() if found == answer]

    def close(self):
        self._bus.shutdown()


@pytest.fixture
def wire():
    bench = JointBench("csp", position=-0.2, quantities=("position",))
    made = Wire(bench)
    bench.rig.step(0.0)
    yield made
    bench.close()
    made.close()


COMMISSIONING = """
    2B 40 60 00 00 00 00 00   controlword: disable voltage
    23 01 14 01 05 03 00 80   RPDO2 to 4 off
    23 02 14 01 05 04 00 80
    23 03 14 01 05 05 00 80
    23 01 18 01 85 02 00 C0   TPDO2 to 4 off, no requests as before
    23 02 18 01 85 03 00 C0
    23 03 18 01 85 04 00 C0
    23 00 14 01 05 02 00 80   RPDO1 off
    2F 00 14 02 01 00 00 00   at every SYNC
    2F 00 16 00 00 00 00 00   empty
    23 00 16 01 10 00 40 60   controlword
    23 00 16 02 20 00 7A 60   target position
    2F 00 16 00 02 00 00 00   two objects
    23 00 14 01 05 02 00 00   on
    23 00 18 01 85 01 00 C0   TPDO1 off
    2F 00 18 02 01 00 00 00   at every SYNC
    2F 00 1A 00 00 00 00 00   empty
    23 00 1A 01 10 00 41 60   statusword
    23 00 1A 02 20 00 64 60   position actual value
    2F 00 1A 00 02 00 00 00   two objects
    23 00 18 01 85 01 00 40   on
    2B 17 10 00 64 00 00 00   heartbeat every 100 ms
    23 16 10 01 96 00 7F 00   watch node 127, 150 ms
    2F 60 60 00 08 00 00 00   cyclic synchronous position
    2F C2 60 01 05 00 00 00   set-points every 5
    2F C2 60 02 FD 00 00 00   thousandths of a second
    2B 07 60 00 03 00 00 00   quick stop when the connection is lost
    2F 29 10 01 00 00 00 00   pre-operational when the heartbeat is lost
    2B 5A 60 00 02 00 00 00   quick stop, then without power
"""


def written(text):
    """The bytes of a list with a remark behind each line."""
    return [line.strip().split("   ")[0] for line in text.strip().splitlines()]


def test_what_a_drive_is_told(wire):
    wire.bench.open()
    requests = wire.frames(REQUEST, 0x000)
    writes = [data for identifier, data in requests if identifier == REQUEST and not data.startswith("40")]
    assert writes == written(COMMISSIONING)
    assert [data for identifier, data in requests if identifier == 0x000] == ["80 05", "01 05"]
    reads = [data for identifier, data in requests if data.startswith("40")]
    assert reads[:4] == [
        "40 00 10 00 00 00 00 00",
        "40 18 10 01 00 00 00 00",
        "40 18 10 02 00 00 00 00",
        "40 18 10 04 00 00 00 00",
    ]


def test_every_write_is_read_back(wire):
    wire.bench.open()
    frames = [data for _, data in wire.frames(REQUEST)]
    for place in (
        "00 14 02",
        "00 16 01",
        "00 16 02",
        "00 16 00",
        "00 14 01",
        "00 1A 01",
        "17 10 00",
        "16 10 01",
        "07 60 00",
    ):
        last_write = max(n for n, data in enumerate(frames) if data[3:11] == place and not data.startswith("40"))
        assert f"40 {place} 00 00 00 00" in frames[last_write:]


@pytest.mark.parametrize(
    ("request_bytes", "answer"),
    [
        ("40 00 10 00 00 00 00 00", "43 00 10 00 92 01 02 00"),  # device type: servo drive, profile 402
        ("40 60 60 00 00 00 00 00", "4F 60 60 00 00 00 00 00"),  # one byte
        ("40 02 65 00 00 00 00 00", "43 02 65 00 E1 03 00 00"),  # pp, hm, ip, csp, csv, cst
        ("2F 60 60 00 08 00 00 00", "60 60 60 00 00 00 00 00"),
        ("2B 40 60 00 06 00 00 00", "60 40 60 00 00 00 00 00"),
        ("23 7A 60 00 F0 D8 FF FF", "60 7A 60 00 00 00 00 00"),
        ("2F 60 60 00 02 00 00 00", "80 60 60 00 30 00 09 06"),  # a mode that it does not have: value range
        ("23 00 10 00 00 00 00 00", "80 00 10 00 02 00 01 06"),  # read only
        ("40 FF 5F 00 00 00 00 00", "80 FF 5F 00 00 00 02 06"),  # no such object
        ("40 18 10 09 00 00 00 00", "80 18 10 09 11 00 09 06"),  # no such sub-index
        ("2B 60 60 00 08 00 00 00", "80 60 60 00 12 00 07 06"),  # too long
        ("23 00 1A 01 10 00 40 60", "80 00 1A 01 22 00 00 08"),  # not while the PDO is on
    ],
)
def test_the_simulated_drive_answers_sdo_as_the_standard_says(wire, request_bytes, answer):
    assert wire.ask(REQUEST, request_bytes, ANSWER) == [answer]


def test_nmt_and_heartbeat_on_the_wire(wire):
    wire.bench.open()
    wire.frames()
    wire.bench.cycle(60)
    frames = wire.frames()
    assert {data for identifier, data in frames if identifier == 0x705} == {"05"}
    assert {data for identifier, data in frames if identifier == 0x77F} == {"05"}  # the HAL's own
    assert {data for identifier, data in frames if identifier == 0x080} == {""}  # SYNC
    assert wire.ask(0x000, "81 05", 0x705) == ["00"]  # reset node: boot-up


STATUSWORDS = {
    # xxxx xxxx x0xx 0000 and so on (CiA 402-2, coding of the state), with voltage enabled and remote
    "SWITCH_ON_DISABLED": 0x0250,
    "READY_TO_SWITCH_ON": 0x0231,
    "SWITCHED_ON": 0x0233,
    "OPERATION_ENABLED": 0x0237,
    "QUICK_STOP_ACTIVE": 0x0217,
    "FAULT_REACTION_ACTIVE": 0x021F,
    "FAULT": 0x0218,
}


@pytest.mark.parametrize("name", STATUSWORDS)
def test_both_ends_code_the_states_alike(name):
    word = STATUSWORDS[name]
    assert cia402.state(word) is State[name.removesuffix("_ACTIVE") if name.startswith("FAULT_") else name]
    assert drive_states.State[name] == word & 0x6F


def test_enabling_and_letting_go_word_by_word(wire):
    """At zero counts: 06 00 shutdown, 07 00 switch on, 0F 00 enable operation, target 0."""
    bench = wire.bench.open()
    bench.cycle(3)
    wire.frames()
    bench.enable()
    commands = [data for _, data in wire.frames(0x205)]
    order = list(dict.fromkeys(commands))
    assert order == ["00 00 00 00 00 00", "06 00 00 00 00 00", "07 00 00 00 00 00", "0F 00 00 00 00 00"]
    bench.robot.disable()
    bench.cycle(10)
    assert [data for _, data in wire.frames(0x205)][-1] == "06 00 00 00 00 00"
    bench.cycle()
    assert wire.frames(0x185)[-1][1] == "31 02 00 00 00 00"


def test_quick_stop_and_fault_reset_word_by_word(wire):
    bench = wire.bench.open()
    bench.enable()
    wire.frames()
    bench.drive.quick_stop()
    assert wire.frames(0x205)[-1][1] == "02 00 00 00 00 00"
    bench.rig.fault("emcy elbow")
    bench.cycle(30)
    assert "00 50 01 00 00 00 00 00" in [data for _, data in wire.frames(0x085)]
    bench.robot.reset()
    bench.cycle(10)
    words = [data[:5] for _, data in wire.frames(0x205)]
    assert "80 00" in words
    before = words[words.index("80 00") - 1]
    assert before == "00 00"  # a rising edge
    assert {word for word in words if word not in ("80 00", "00 00")} <= {"06 00"}


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        ("30 81 11 00 00 00 00 00", "heartbeat error (8130h) (register: generic, communication)"),
        ("10 23 03 01 02 00 00 00", "current, device output side (2310h) (register: generic, current; manufacturer 01"),
        ("11 86 21 00 00 00 00 FF", "following error (8611h) (register: generic, device profile; manufacturer 00 00"),
    ],
)
def test_emergencies_in_words(wire, frame, text):
    bench = wire.bench.open()
    bench.cycle(3)
    bench.send("can0", 0x085, bytes.fromhex(frame))
    bench.flush()
    assert text in bench.device("elbow")["text"]
    bench.send("can0", 0x085, bytes(8))
    bench.flush()
    assert bench.device("elbow")["state"] == "ready"


SPEAKS = {
    # request of the client -> answer of the server
    "40 60 60 00 00 00 00 00": "4F 60 60 00 FE 00 00 00",
    "40 41 60 00 00 00 00 00": "4B 41 60 00 37 02 00 00",
    "40 64 60 00 00 00 00 00": "43 64 60 00 F0 D8 FF FF",
    "2B 40 60 00 0F 00 00 00": "60 40 60 00 00 00 00 00",
    "23 7A 60 00 FE FF FF FF": "60 7A 60 00 00 00 00 00",
    "2F 60 60 00 0B 00 00 00": "80 60 60 00 30 00 09 06",
    "40 00 20 00 00 00 00 00": "41 00 20 00 09 00 00 00",
}


@pytest.fixture
def client():
    """The HAL's SDO client, and a server that knows nothing but the table."""
    channel = "golden_sdo"
    bus = Bus("can0", BusConfig(interface="virtual", channel=channel), SystemClock())
    made = SdoClient(bus, NODE, data_sheet(ROBOTS / "eds" / "servo_drive.eds"), "'elbow'")
    server = can.Bus(interface="virtual", channel=channel)
    done = threading.Event()

    def serve():
        while not done.is_set():
            message = server.recv(0.05)
            answer = SPEAKS.get(message.data.hex(" ").upper()) if message else None
            if answer:
                server.send(can.Message(arbitration_id=ANSWER, data=bytes.fromhex(answer), is_extended_id=False))

    thread = threading.Thread(target=serve)
    bus.open()
    thread.start()
    yield made
    done.set()
    thread.join()
    bus.close()
    server.shutdown()


def test_the_client_reads_and_writes_by_the_table(client):
    assert client.read(0x6041, 0) == 0x0237
    assert client.read_signed(0x6064, 0, 32) == -10_000
    assert client.read_signed(0x6060, 0, 8) == -2
    client.write(0x6040, 0, 0x000F, 2)
    client.write(0x607A, 0, -2, 4)


def test_the_client_tells_an_abort_in_words(client):
    with pytest.raises(DeviceRefused, match="refused object 6060h:0: 06090030h, the value is out of range"):
        client.write(0x6060, 0, 11, 1)
    with pytest.raises(DeviceRefused, match="object 2000h:0 is longer than four bytes"):
        client.read(0x2000, 0)


def test_heartbeat_consumer_and_mapping_entries():
    assert cia301.consumer_heartbeat(127, 0.15).to_bytes(4, "little") == bytes.fromhex("96 00 7F 00")
    entries = {
        cia402.CONTROLWORD: 0x60400010,
        cia402.STATUSWORD: 0x60410010,
        cia402.MODE_OF_OPERATION: 0x60600008,
        cia402.MODE_DISPLAY: 0x60610008,
        cia402.POSITION: 0x60640020,
        cia402.VELOCITY: 0x606C0020,
        cia402.TARGET_TORQUE: 0x60710010,
        cia402.TORQUE: 0x60770010,
        cia402.TARGET_POSITION: 0x607A0020,
        cia402.FOLLOWING_ERROR: 0x60F40020,
        cia402.TARGET_VELOCITY: 0x60FF0020,
    }
    assert {item.entry for item in entries} == set(entries.values())
    assert all(item.entry == entry for item, entry in entries.items())


@pytest.mark.parametrize(
    ("code", "per_turn", "counts_per_second"),
    [
        (0x00B44700, 4096, 4096 / 60),
        (0xFDB44700, 4096, 4096 / 60_000),
        (0x00B40300, 4096, 4096),
        (0x00B50300, 4096, 1.0),
        (0x00410300, 4096, None),
        (0x00000000, 4096, None),
    ],
)
def test_velocity_units(code, per_turn, counts_per_second):
    unit = cia402.velocity_unit(code)
    found = unit.counts_per_second(per_turn) if unit else None
    assert found == (counts_per_second if counts_per_second is None else pytest.approx(counts_per_second))


@pytest.mark.parametrize(
    ("rate", "value", "index"),
    [(200, 5, -3), (100, 10, -3), (1000, 1, -3), (400, 25, -4), (300, 33, -4), (2000, 5, -4)],
)
def test_interpolation_periods(rate, value, index):
    assert cia402.interpolation(1 / rate) == (value, index)


def test_no_set_point_goes_to_a_drive_before_it_is_commissioned_and_has_reported_where_it_is(wire):
    """A target of 0 counts, sent before the position is known, would move the joint to its zero when it is enabled."""
    bench = wire.bench.open()
    bench.cycle(3)
    drive = bench.drive
    wire.frames()
    drive.idle()
    assert [data for _, data in wire.frames(0x205)] == ["00 00 00 00 00 00"]
    drive.is_commissioned = False
    drive.idle()
    assert wire.frames(0x205) == []
    drive.is_commissioned = True
    for missing in ({"_statusword": -1}, {"_counts": None}):
        before = {name: getattr(drive, name) for name in missing}
        for name, value in missing.items():
            setattr(drive, name, value)
        drive.idle()
        assert wire.frames(0x205) == []
        for name, value in before.items():
            setattr(drive, name, value)
    drive.idle()
    assert len(wire.frames(0x205)) == 1
