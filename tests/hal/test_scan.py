"""Who is on a bus, found out by listening and by asking; all on `virtual` buses with simulated nodes."""

import itertools
import threading
from contextlib import contextmanager

import can
import pytest
from device_kinds import DBC_CELL
from hal_bench import BenchWorld, description, hardware

from hal.config import BusConfig, RobotConfig
from hal.errors import BusGone, ConfigError
from hal.finding.dbc_nodes import DbcDevice, dbc_devices
from hal.finding.scan import EXTENDED, compare, scan
from hal.finding.tap import Tap
from hal.protocols.can_frames import fd_bits
from simulators.nodes.canopen.spec import CellConstants, NodeSpec
from simulators.rig import Rig

PATIENCE = 0.5
_numbers = itertools.count()


@contextmanager
def running(nodes=None):
    """A rig in real time; yields its robot file."""
    config = RobotConfig.model_validate(description())
    rig = Rig(config, BenchWorld(), nodes or hardware())
    rig.start()
    try:
        yield config
    finally:
        rig.stop()


@contextmanager
def beside(job):
    """Something that goes on meanwhile: `job` is called again and again."""
    over = threading.Event()

    def run():
        while not over.is_set():
            job()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def bus(config=None):
    """A tap and a wire on one virtual bus."""
    config = config or BusConfig(interface="virtual", channel=f"scan_{next(_numbers)}")
    wire = can.Bus(interface="virtual", channel=config.channel)
    with Tap("can0", config) as tap:
        yield tap, wire
    wire.shutdown()


def send(wire, identifier, data=""):
    wire.send(can.Message(arbitration_id=identifier, data=bytes.fromhex(data), is_extended_id=False))


@pytest.mark.long
def test_every_node_is_found_and_tells_who_it_is():
    with running() as config, Tap("can1", config.buses["can1"]) as tap:
        found = scan(tap, listen=0.1, patience=PATIENCE)
    assert [one.node for one in found.nodes] == [2, 12, 21]
    drive, cell, encoder = found.nodes
    assert (drive.kind, cell.kind, encoder.kind) == ("servo drive (402)", "measuring device (404)", "encoder (406)")
    assert drive.number(0x1018, 4) == hardware()[1].serial
    assert drive.text(0x1008)
    assert not any(one.is_doubled for one in found.nodes)
    assert not found.silence and not found.unknown
    assert compare(found, config) == []


def test_nobody_is_asked_while_a_master_is_heard():
    with running() as config, bus(config.buses["can1"]) as (tap, wire):
        send(wire, 0x080)
        found = scan(tap, listen=0.1, patience=PATIENCE)
        requests = []
        while (message := wire.recv(0.05)) is not None:
            requests.append(message.arbitration_id & 0x780 == 0x600)
    assert "its SYNC" in found.silence
    assert not any(requests)


def test_listening_only_sends_nothing():
    with bus() as (tap, wire):
        send(wire, 0x70B, "05")
        found = scan(tap, listen=0.1, ask=False)
        assert wire.recv(0.0) is None
    assert [(one.node, one.state, one.kind) for one in found.nodes] == [(11, "operational", "")]
    assert found.silence


@pytest.mark.long
def test_missing_unexpected_and_wrong_nodes_are_told():
    nodes = [
        NodeSpec("cell", "can1", 2, "muscle_tension.biceps", CellConstants()),
        NodeSpec("other", "can1", 33, "muscle_tension.triceps", CellConstants()),
        hardware()[3],
    ]
    with running(nodes) as config, Tap("can1", config.buses["can1"]) as tap:
        report = compare(scan(tap, listen=0.1, patience=PATIENCE), config)
    text = " ".join(report)
    assert len(report) == 3
    assert "node 2 ('triceps_drive') is a measuring device (404), the robot file says cia402" in text
    assert "node 21 ('elbow_encoder') was not found" in text
    assert "node 33 is not in the robot file" in text


@pytest.mark.long
def test_two_nodes_with_one_id_are_told():
    with running() as config, bus(config.buses["can1"]) as (tap, wire):

        def answer():
            message = wire.recv(0.01)
            if message is not None and message.arbitration_id == 0x602 and message.data[0] == 0x40:
                data = bytes([0x43]) + bytes(message.data[1:4]) + bytes.fromhex("92010200")
                wire.send(can.Message(arbitration_id=0x582, data=data, is_extended_id=False))

        with beside(answer):
            found = scan(tap, listen=0.1, patience=PATIENCE)
    assert [one.node for one in found.nodes if one.is_doubled] == [2]
    assert any("more than one node answers as node 2" in text for text in compare(found, config))


def test_an_odrive_is_recognised_and_never_sent_what_it_would_take_for_a_command():
    with bus() as (tap, wire):
        for _ in range(3):
            send(wire, 48 << 5 | 1, "00 00 00 00 08 00 00 01")
        found = scan(tap, listen=0.1, patience=0.01)
        sent = []
        while (message := wire.recv(0.0)) is not None:
            sent.append(message.arbitration_id)
    assert [(one.protocol, one.node, one.state) for one in found.nodes] == [("ODrive", 48, "axis state 8")]
    assert sent and not [identifier for identifier in sent if identifier >> 5 == 48]


@pytest.mark.long
def test_mit_drives_are_looked_for_only_when_asked():
    with bus() as (tap, wire):
        asked = []

        def answer():
            message = wire.recv(0.01)
            if message is not None and message.data == b"\xff" * 7 + b"\xfd":
                asked.append(message.arbitration_id)
                if message.arbitration_id == 3:
                    send(wire, 0x000, "03 80 00 7F F7 FF 1E 1E")

        with beside(answer):
            assert scan(tap, listen=0.0, ask=False).nodes == []
            assert not asked
            found = scan(tap, listen=0.0, ask=False, mit=True, patience=PATIENCE)
    assert [(one.protocol, one.node) for one in found.nodes] == [("MIT", 3)]


@pytest.mark.long
def test_a_search_for_mit_drives_takes_no_other_frame_for_an_answer_and_leaves_odrives_alone():
    with bus() as (tap, wire):
        sent = []

        def babble():
            message = wire.recv(0.002)
            sent.extend([message.arbitration_id] if message is not None else [])
            send(wire, 0x129, "10 00 00 00 00 00 00 00")
            send(wire, 0x021, "00 00 00 00 01 00 00 00")

        with beside(babble):
            found = scan(tap, listen=0.3, ask=False, mit=True, patience=PATIENCE)
    assert [(one.protocol, one.node) for one in found.nodes] == [("ODrive", 1)]
    assert 31 in sent and 32 not in sent


def test_mit_frames_are_recognised_by_listening():
    with bus() as (tap, wire):
        send(wire, 0x004, "FF FF FF FF FF FF FF FC")
        send(wire, 0x014, "14 80 00 7F F7 FF 1E 1E")
        found = scan(tap, listen=0.1, ask=False)
    assert [(one.protocol, one.node, one.state) for one in found.nodes] == [
        ("MIT", 4, "received the command to enter motor mode")
    ]
    assert not found.unknown


def test_unknown_frames_are_told_with_their_rate():
    with bus() as (tap, wire):
        for _ in range(5):
            send(wire, 0x2F1, "00 01")
        found = scan(tap, listen=0.1, ask=False)
    assert found.unknown == {0x2F1: pytest.approx(50)}
    assert found.load > 0


def test_a_frame_of_any_kind_does_no_harm():
    with bus() as (tap, wire):
        for identifier in range(0, 0x800, 3):
            send(wire, identifier, "FF" * (identifier % 9))
        wire.send(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, dlc=8))
        wire.send(can.Message(arbitration_id=0x583, is_remote_frame=True, is_extended_id=False))
        wire.send(can.Message(arbitration_id=0x1ABCDEF, is_extended_id=True, data=b"123"))
        assert scan(tap, listen=0.1, ask=False).silence


def test_a_bus_that_is_not_there():
    with pytest.raises(ConfigError, match=r"not known to python-can\. Known: "):
        Tap("can0", BusConfig(interface="telepathy", channel="x"))
    with (
        pytest.raises(BusGone, match=r"'can0' .hub nobody_serves_this. does not open: .*gemuco simulate"),
        Tap("can0", BusConfig(interface="hub", channel="nobody_serves_this")),
    ):
        raise AssertionError("it opened")


def test_nodes_with_a_dbc_file_are_known_by_their_messages_and_sent_nothing():
    body = description()
    cells = {"driver": "dbc", "settings": {**DBC_CELL, "node_offset": 1}}
    body["kinds"]["wire_cell"] = cells
    body["signals"]["wire_force"] = {"unit": "N", "elements": ["left", "right"]}
    for node, element in ((5, "left"), (6, "right")):
        body["devices"][element] = {
            "kind": "wire_cell",
            "bus": "can1",
            "node": node,
            "element": f"wire_force.{element}",
        }
    config = RobotConfig.model_validate(body)
    devices = dbc_devices(config, "can1")
    assert [device.name for device in devices] == ["left", "right"]
    assert dbc_devices(config, "can0") == ()
    with bus(config.buses["can1"]) as (tap, wire):
        for _ in range(3):
            send(wire, 0x180 + 5, "10 27 00 00 41")
        tap.name = "can1"
        found = scan(tap, listen=0.2, ask=False, devices=devices)
    assert [(one.node, one.kind, one.state) for one in found.nodes] == [(5, "node of a DBC file", "sends Force")]
    assert not found.unknown
    report = [text for text in compare(found, config) if "Force" in text or "left" in text]
    assert report == [
        "can1: node 6 ('right') was not heard: none of Force came. Is it powered, is its node id right, is it set to "
        "send?"
    ]


def test_identifiers_of_29_bits_are_listed_and_belong_to_dbc_nodes():
    with bus() as (tap, wire):
        for identifier in (0x18FF0201, 0x18FF0301):
            wire.send(can.Message(arbitration_id=identifier, data=bytes(8), is_extended_id=True))
        device = DbcDevice("axis", 1, {(0x18FF0201, True): "Status"}, frozenset({(0x18FF0201, True), (0x605, False)}))
        found = scan(tap, listen=0.1, patience=0.05, devices=(device,))
        asked = set()
        while (message := wire.recv(0.0)) is not None:
            asked.add(message.arbitration_id)
    assert list(found.unknown) == [EXTENDED | 0x18FF0301]
    assert list(found.named) == ["axis"]
    assert {0x604, 0x606} <= asked
    assert 0x605 not in asked  # a frame that the axis would take for its own


def test_frames_of_can_fd_load_the_bus_and_are_no_nodes_of_canopen():
    config = BusConfig(interface="virtual", channel=f"scan_{next(_numbers)}", data_bitrate=1_000_000)
    with bus(config) as (tap, wire):
        for _ in range(10):
            wire.send(can.Message(arbitration_id=0x705, data=bytes(64), is_fd=True, is_extended_id=False))
        result = scan(tap, listen=0.2, ask=False)
    assert not result.nodes
    assert result.unknown == {0x705: pytest.approx(50.0)}
    assert result.load == pytest.approx(10 * sum(fd_bits(64)) / 0.2e6)
