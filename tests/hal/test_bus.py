"""One bus by itself, against the hub and against nothing."""

import threading
import time

import can
import pytest

from hal.clock import ManualClock, SystemClock
from hal.config import BusConfig
from hal.errors import ConfigError
from hal.wire.bus import Bus, BusState
from simulators.hub import HubServer

LIMIT = 10.0


@pytest.fixture
def channel(tmp_path):
    return str(tmp_path / "can")


@pytest.fixture
def bus(channel):
    bus = Bus("can0", BusConfig(interface="hub", channel=channel), SystemClock())
    yield bus
    bus.close()


def wait_for(condition, what):
    deadline = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.005)


def frame(identifier=0x181, data=b"12345678"):
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def test_without_a_peer_it_is_gone_and_goes_on_trying(bus):
    bus.open()
    assert bus.state is BusState.GONE
    assert "Is `gemuco simulate` running?" in bus.text
    assert not bus.send(frame())
    assert bus.counters["send_failures"] == 1


def test_it_is_there_when_a_frame_was_heard_and_not_before(bus, channel):
    heard = []
    bus.subscribe(0x181, lambda data, received: heard.append((bytes(data), received)))
    bus.open()
    with HubServer(channel):
        wait_for(lambda: bus.counters["opened"] == 1, "the interface")
        assert bus.state is BusState.GONE
        with can.Bus(interface="hub", channel=channel) as peer:
            peer.send(frame())
            wait_for(lambda: heard, "the frame")
        assert bus.state is BusState.OK
        assert heard[0][0] == b"12345678"
        assert heard[0][1] == pytest.approx(time.monotonic(), abs=LIMIT)
    wait_for(lambda: bus.state is BusState.GONE, "the end")


def test_it_comes_back_with_its_peer(bus, channel):
    for round_number in range(1, 4):
        with HubServer(channel):
            if round_number == 1:
                bus.open()
            wait_for(lambda: bus.counters["opened"] == round_number, "the interface")  # noqa: B023
            wait_for(lambda: bus.send(frame()), "a frame that can be sent")
        wait_for(lambda: not bus.send(frame()), "a frame that cannot")


@pytest.mark.long
def test_an_interface_that_stays_silent_is_opened_again(channel):
    bus = Bus("can0", BusConfig(interface="virtual", channel=channel), SystemClock())
    bus.open()
    wait_for(lambda: bus.counters["opened"] >= 2, "reopening")
    bus.close()
    assert bus.state is BusState.GONE


def test_an_interface_that_does_not_send_is_opened_again(channel):
    bus = Bus("can0", BusConfig(interface="virtual", channel=channel), SystemClock())
    with can.Bus(interface="virtual", channel=channel, rx_queue_size=1):
        bus.open()
        assert bus.send(frame())
        assert [bus.send(frame()) for _ in range(3)] == [False] * 3
        assert "could not be sent" in bus.text
        wait_for(lambda: bus.counters["opened"] >= 2, "reopening")
    bus.close()


def test_load_is_what_went_over_the_wire_both_ways(channel):
    clock = ManualClock()
    bus = Bus("can0", BusConfig(interface="virtual", channel=channel), clock)
    bus.open()
    with can.Bus(interface="virtual", channel=channel) as peer:
        wait_for(lambda: bus.counters["opened"], "the interface")
        clock.advance(1.0)
        peer.send(frame())
        wait_for(lambda: bus.counters["received"] == 1, "the frame that ends the first second")
        for _ in range(100):
            bus.send(frame())
            peer.send(frame(0x181, b"1"))
        wait_for(lambda: bus.counters["received"] == 101, "the frames")
        clock.advance(1.0)
        peer.send(frame(0x181, b""))
        wait_for(lambda: bus.health()["load"] > 0, "the load")
        assert bus.health()["load"] == pytest.approx((100 * 135 + 100 * 65 + 55) / 1e6, abs=1e-4)
    bus.close()


def test_two_devices_cannot_share_an_identifier(bus):
    bus.subscribe(0x181, lambda data, received: None)
    with pytest.raises(ConfigError, match="181h"):
        bus.subscribe(0x181, lambda data, received: None)


def test_closing_twice_is_safe_and_ends_the_thread(bus):
    bus.open()
    bus.close()
    bus.close()
    assert not any(thread.name == "bus can0" for thread in threading.enumerate())
