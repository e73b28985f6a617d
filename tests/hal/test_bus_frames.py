"""What a bus makes of frames it is not meant to get: strange, malformed, too many."""

import threading
import time

import can
import pytest

from hal.clock import ManualClock
from hal.config import BusConfig
from hal.errors import ConfigError
from hal.wire.bus import Bus
from hal.wire.kernel import Kernel
from hal.wire.receive import STATISTICS_PERIOD
from hal.wire.routes import BABBLE, STRANGERS, WINDOW, Routes

ALLOWED = round(BABBLE * WINDOW)


@pytest.fixture
def bus(tmp_path):
    """A bus whose frames the test hands over itself."""
    bus = Bus("can0", BusConfig(interface="virtual", channel=str(tmp_path)), ManualClock())
    bus._watch.opened("open")
    bus.receive = lambda message: bus._handle(message, bus._clock.monotonic())
    return bus


def frame(identifier=0x181, data=b"12345678", **more):
    return can.Message(**{"arbitration_id": identifier, "data": data, "is_extended_id": False, **more})


@pytest.mark.parametrize(
    "strange",
    [
        frame(data=None, is_remote_frame=True, dlc=8),
        frame(data=bytes(12), is_fd=True),
        frame(data=bytes(9)),
        frame(data=bytes(8), is_fd=True),
    ],
    ids=["remote", "fd", "9 bytes", "short fd"],
)
def test_a_frame_that_no_classic_node_sends_is_counted_and_ignored(bus, strange):
    heard = []
    bus.subscribe(0x181, lambda data, received: heard.append(bytes(data)))
    bus.receive(strange)
    bus.receive(frame())
    assert heard == [b"12345678"]
    assert bus.counters["ignored"] == 1
    assert bus.state == "ok"


@pytest.mark.parametrize("size", range(9))
def test_frames_of_every_length_reach_their_handler(bus, size):
    heard = []
    bus.subscribe(0x181, lambda data, received: heard.append(len(data)))
    bus.receive(frame(data=bytes(size)))
    assert heard == [size]


def test_long_identifiers_are_others_than_short_ones(bus):
    heard = []
    bus.subscribe(0x181, lambda data, received: heard.append("short"))
    bus.subscribe(0x181, lambda data, received: heard.append("long"), extended=True)
    bus.subscribe(0x18DAF110, lambda data, received: heard.append("longer"), extended=True)
    bus.receive(frame(is_extended_id=True))
    bus.receive(frame())
    bus.receive(frame(0x18DAF110, is_extended_id=True))
    assert heard == ["long", "short", "longer"]


@pytest.mark.parametrize(("identifier", "extended"), [(0x800, False), (-1, False), (1 << 29, True)])
def test_identifiers_that_do_not_exist_are_refused(bus, identifier, extended):
    with pytest.raises(ConfigError, match="There is no identifier"):
        bus.subscribe(identifier, print, extended)


@pytest.mark.parametrize("error", [ValueError("x"), SystemExit(3), MemoryError(), KeyboardInterrupt()], ids=repr)
def test_whatever_a_handler_raises_is_told_and_the_next_frame_handled(bus, caplog, error):
    heard = []

    def handler(data, received):
        heard.append(bytes(data))
        if data == b"bad":
            raise error

    bus.subscribe(0x181, handler)
    for _ in range(3):
        bus.receive(frame(data=b"bad"))
    bus.receive(frame(data=b"good"))
    assert heard == [b"bad"] * 3 + [b"good"]
    assert bus.counters["broken_handlers"] == 3
    assert bus.state == "warning"
    assert f"identifier 181h on bus can0: {type(error).__name__}" in bus.text
    assert [record.levelname for record in caplog.records].count("ERROR") == 1, (
        "a handler that fails for every frame is logged once in a while"
    )


def test_a_babbling_node_is_cut_off_and_told_and_the_others_are_not(bus):
    heard = {0x181: 0, 0x182: 0}
    for identifier in heard:
        bus.subscribe(identifier, lambda data, received, key=identifier: heard.update({key: heard[key] + 1}))
    windows = round(STATISTICS_PERIOD / WINDOW)
    for _ in range(windows):
        for _ in range(1000):
            bus.receive(frame())
        bus.receive(frame(0x182))
        bus._clock.advance(WINDOW)
    bus.receive(frame(0x182))
    assert heard[0x182] == windows + 1
    assert heard[0x181] == windows * ALLOWED
    assert bus.counters["babbled"] == windows * (1000 - ALLOWED)
    bus._receiver._last = (bus._clock.monotonic() - STATISTICS_PERIOD, 0, None)
    bus._receiver.update_statistics(bus._clock.monotonic(), 0)
    assert bus.state == "warning"
    assert bus.text == "Identifier 181h babbles: 20000 frames/s. Frames above the limit are not handled."


def test_a_stranger_that_babbles_is_told_too(bus):
    for _ in range(20_000):
        bus.receive(frame(0x001))
    bus._receiver._last = (bus._clock.monotonic() - STATISTICS_PERIOD, 0, None)
    bus._receiver.update_statistics(bus._clock.monotonic(), 0)
    assert "Identifier 001h babbles: 20000 frames/s" in bus.text


def test_a_bus_that_is_nearly_full_is_told(bus):
    bus._receiver.update_statistics(bus._clock.monotonic(), 0)
    for _ in range(7000):
        bus.receive(frame())
    bus._clock.advance(STATISTICS_PERIOD)
    bus._receiver.update_statistics(bus._clock.monotonic(), 0)
    assert bus.health()["load"] == pytest.approx(0.945)
    assert bus.state == "warning"
    assert bus.text.startswith("The bus is loaded to 94%.") or bus.text.startswith("Identifier 181h babbles")


def test_frames_that_the_kernel_keeps_away_load_the_bus_all_the_same(bus, tmp_path):
    (tmp_path / "can0" / "statistics").mkdir(parents=True)
    (tmp_path / "can0" / "device").mkdir()
    count = tmp_path / "can0" / "statistics" / "rx_packets"
    kernel = Kernel("socketcan", "can0", tmp_path)
    assert kernel.received() is None
    count.write_text("1000\n")
    bus._receiver.update_statistics(bus._clock.monotonic(), 0, kernel.received())
    for _ in range(1000):
        bus.receive(frame())
    count.write_text("8000\n")
    bus._clock.advance(STATISTICS_PERIOD)
    bus._receiver.update_statistics(bus._clock.monotonic(), 0, kernel.received())
    assert bus.health()["load"] == pytest.approx(7000 * 135e-6)
    assert bus.text.startswith("The bus is loaded to 94%.")
    assert Kernel("hub", "can0", tmp_path).received() is None
    assert Kernel("socketcan", "vcan0", tmp_path).received() is None


def test_nodes_that_the_robot_file_does_not_name_are_told_until_they_are_gone(bus):
    bus._receiver.has_master = True
    bus.subscribe(0x701, lambda data, received: None)
    bus.receive(frame(0x701, b"\x05"))
    bus.receive(frame(0x725, b"\x05"))
    bus.receive(frame(0x1A5))
    assert bus.health()["unknown"] == ["identifier 1A5h", "node 37"]
    assert bus.counters["unknown"] == 2
    for _ in range(12):
        bus._clock.advance(STATISTICS_PERIOD)
        bus._receiver.update_statistics(bus._clock.monotonic(), 0)
    assert bus.health()["unknown"] == []


@pytest.mark.parametrize("identifier", [0x080, 0x77F])
def test_another_master_on_the_bus_is_told(bus, identifier):
    bus._receiver.has_master = True
    bus._receiver.update_statistics(bus._clock.monotonic(), 0)
    bus.receive(frame(identifier, b""))
    bus._clock.advance(STATISTICS_PERIOD)
    bus._receiver.update_statistics(bus._clock.monotonic(), 0)
    assert (
        bus.text
        == f"Another node sends our identifier {identifier:03X}h. Is another master or another HAL on this bus?"
    )


def test_more_strangers_than_can_be_told_apart_are_counted():
    routes = Routes("can0")
    for identifier in range(STRANGERS):
        assert routes.stranger(identifier) is not None
    assert routes.stranger(STRANGERS) is None
    routes.add(5, print, False)
    assert routes.stranger(STRANGERS) is not None


def lets_in(filters, identifier, extended=False):
    return any(one["extended"] == extended and (identifier ^ one["can_id"]) & one["can_mask"] == 0 for one in filters)


def test_filters_let_in_what_is_wanted_and_what_tells_of_strangers():
    routes = Routes("can0")
    for identifier in (0x181, 0x581, 0x701, 0x081):
        routes.add(identifier, print, False)
    routes.add(0x18DAF110, print, True)
    routes.stranger(0x123)
    filters = routes.filters()
    for identifier in (0x181, 0x581, 0x701, 0x081, 0x725, 0x0A5, 0x080, 0x000, 0x77F):
        assert lets_in(filters, identifier), hex(identifier)
    for identifier in (0x001, 0x123, 0x182, 0x582, 0x600, 0x7FF):
        assert not lets_in(filters, identifier), hex(identifier)
    assert lets_in(filters, 0x18DAF110, True)
    assert not lets_in(filters, 0x181, True)
    assert len(filters) == 3 + 2 + 1, "what a listened range covers needs no filter of its own"


def test_a_stuck_interface_makes_the_bus_gone_though_nothing_is_raised(tmp_path, monkeypatch):
    monkeypatch.setattr("hal.wire.state.HANGS", 0.2)
    bus = Bus("can0", BusConfig(interface="virtual", channel=str(tmp_path)), ManualClock())
    release = threading.Event()
    bus.subscribe(0x181, lambda data, received: release.wait(10.0))
    bus.open()
    try:
        with can.Bus(interface="virtual", channel=str(tmp_path)) as peer:
            peer.send(frame(0x182))
            deadline = time.monotonic() + 10.0
            while bus.state != "ok":
                assert time.monotonic() < deadline
                time.sleep(0.001)
            assert bus.trouble() == ""
            peer.send(frame())
            while bus.state == "ok":
                assert time.monotonic() < deadline
                bus.begin()
                time.sleep(0.01)
            assert bus.trouble() == "is gone. Its receive thread hangs. Is the adapter still plugged in?"
            assert not bus.health()["is_receiving"]
            release.set()
            while not bus.is_receiving:
                assert time.monotonic() < deadline
                peer.send(frame(0x182))
                time.sleep(0.01)
            while bus.state != "ok":
                assert time.monotonic() < deadline
                time.sleep(0.001)
    finally:
        release.set()
        bus.close()
