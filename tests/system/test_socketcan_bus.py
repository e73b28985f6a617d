"""One bus on the vcan of a real Linux kernel: stamps, filters, buffers, error frames, and links that go and come back.

`make test-socketcan` runs this in a kernel that has vcan0 and vcan1; elsewhere it is skipped.
"""

import contextlib
import os
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.wire.bus import Bus

LIMIT = 20.0
LATE = 0.2
"""A kernel in user mode stands still for so long [s] now and then."""

pytestmark = [
    pytest.mark.skipif(
        not Path("/sys/class/net/vcan1").exists(),
        reason="no vcan1 on this machine; `make test-socketcan` boots a kernel that has it",
    ),
    pytest.mark.timeout(120),
]
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="changes links, which needs root")
needs_own_kernel = pytest.mark.skipif(
    "User Mode Linux" not in Path("/proc/cpuinfo").read_text(), reason="sets the clock of the machine"
)


@pytest.fixture
def bus() -> Iterator[Bus]:
    bus = Bus("can1", BusConfig(interface="socketcan", channel="vcan1"), SystemClock())
    yield bus
    bus.close()


@pytest.fixture
def peer() -> Iterator[can.BusABC]:
    with can.Bus(interface="socketcan", channel="vcan1") as peer:
        yield peer


def frame(identifier: int = 0x181, data: bytes = b"12345678") -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def wait_for(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.005)


def ip(*words: str) -> None:
    subprocess.run(["ip", "link", *words], check=True)


def test_frames_bear_the_time_at_which_the_kernel_got_them(bus: Bus, peer: can.BusABC) -> None:
    hold, ages, handled = threading.Event(), [], []

    def handler(data: bytearray, received: float) -> None:
        hold.wait(LIMIT)
        ages.append(time.monotonic() - received)
        handled.append(data[0])

    bus.subscribe(0x181, handler)
    bus.open()
    assert bus.health()["stamps"] == "kernel"
    peer.send(frame(data=b"\0"))
    peer.send(frame(data=b"\1"))
    time.sleep(0.5)
    hold.set()
    wait_for(lambda: len(handled) == 2, "the frames")
    assert all(0.5 - 0.05 < age < 0.5 + LATE for age in ages), "both waited for half a second, and both say so"
    peer.send(frame(data=b"\2"))
    wait_for(lambda: len(handled) == 3, "the frame")
    assert ages[2] < LATE


@needs_own_kernel
@pytest.mark.parametrize("step", [3600.0, -3600.0, 0.04, -0.04])
def test_setting_the_clock_makes_no_frame_newer_or_older(bus: Bus, peer: can.BusABC, step: float) -> None:
    ages: list[float] = []
    bus.subscribe(0x181, lambda data, received: ages.append(time.monotonic() - received))
    bus.open()
    for number in range(40):
        if number == 20:
            time.clock_settime(time.CLOCK_REALTIME, time.time() + step)
        peer.send(frame())
        wait_for(lambda number=number: len(ages) == number + 1, "the frame")  # type: ignore[misc]
        time.sleep(0.01)
    assert all(0 <= age < LATE for age in ages), ages
    assert sorted(ages)[20] < 0.02
    counters = bus.health()["counters"]
    assert counters["clock_steps"] >= 1
    assert counters["bad_stamps"] == 0


def test_the_kernel_keeps_away_what_nobody_wants(bus: Bus, peer: can.BusABC) -> None:
    heard: list[int] = []
    bus.subscribe(0x181, lambda data, received: heard.append(0x181))
    bus.open()
    bus.subscribe(0x182, lambda data, received: heard.append(0x182))
    for identifier in (0x001, 0x123, 0x181, 0x600, 0x725, 0x182):
        peer.send(frame(identifier, b"\x05"))
    peer.send(can.Message(arbitration_id=0x181, data=b"x", is_extended_id=True))
    wait_for(lambda: heard == [0x181, 0x182], "the frames that are wanted")
    assert bus.counters["unknown"] == 1
    assert bus.health()["unknown"] == ["identifier 725h"]


def test_a_burst_that_comes_while_nobody_reads_is_not_lost(bus: Bus, peer: can.BusABC) -> None:
    hold, count = threading.Event(), [0]

    def handler(data: bytearray, received: float) -> None:
        hold.wait(LIMIT)
        count[0] += 1

    for identifier in range(0x181, 0x18B):
        bus.subscribe(identifier, handler)
    bus.open()
    for number in range(1500):
        peer.send(frame(0x181 + number % 10), 1.0)
    hold.set()
    wait_for(lambda: count[0] + bus.counters["babbled"] == 1500, f"1500 frames, not {count[0]}")


@pytest.mark.parametrize(
    ("kind", "detail", "state"),
    [(0x04, 0x08, "warning"), (0x04, 0x20, "passive"), (0x20, 0, "warning"), (0x40, 0, "bus-off")],
)
def test_error_frames_of_the_kernel_move_the_state(
    bus: Bus, peer: can.BusABC, kind: int, detail: int, state: str
) -> None:
    bus.open()
    peer.send(frame(0x701, b"\5"))
    wait_for(lambda: bus.state == "ok", "the first frame")
    data = bytes((0, detail, 0, 0, 0, 0, 130, 7))
    peer.send(can.Message(arbitration_id=kind, data=data, is_error_frame=True, is_extended_id=False))
    wait_for(lambda: bus.state == state, state)
    assert bus.send(frame(0x201)) == (state != "bus-off")
    peer.send(can.Message(arbitration_id=0x100, data=bytes(8), is_error_frame=True, is_extended_id=False))
    if detail:
        assert bus.health()["error_counters"] == (130, 7)
        wait_for(lambda: bus.state == "ok", "the restart")


@needs_root
def test_a_link_that_goes_down_and_up_again(bus: Bus, peer: can.BusABC) -> None:
    bus.open()
    peer.send(frame(0x701, b"\5"))
    wait_for(lambda: bus.state == "ok", "the first frame")
    ip("set", "vcan1", "down")
    try:
        wait_for(lambda: bus.state == "gone", "the link")
        opened = bus.counters["opened"]
        assert not bus.send(frame(0x201))
        time.sleep(1.0)
        assert bus.state == "gone"
        assert bus.counters["opened"] - opened < 5, "it backs off"
    finally:
        ip("set", "vcan1", "up")
    with can.Bus(interface="socketcan", channel="vcan1") as again:

        def heard() -> bool:
            again.send(frame(0x701, b"\5"))
            return bus.state == "ok"

        wait_for(heard, "the link")
    assert bus.send(frame(0x201))


@needs_root
def test_an_adapter_that_is_unplugged_and_comes_back_under_its_name(bus: Bus, peer: can.BusABC) -> None:
    bus.open()
    peer.send(frame(0x701, b"\5"))
    wait_for(lambda: bus.state == "ok", "the first frame")
    ip("del", "vcan1")
    try:
        wait_for(lambda: bus.state == "gone", "the adapter")
        time.sleep(0.3)
    finally:
        ip("add", "vcan1", "type", "vcan")
        ip("set", "vcan1", "mtu", "72")
        ip("set", "vcan1", "up")
    with can.Bus(interface="socketcan", channel="vcan1") as again:

        def heard() -> bool:
            again.send(frame(0x701, b"\5"))
            return bus.state == "ok"

        wait_for(heard, "the adapter")
    wait_for(lambda: bus.send(frame(0x201)), "a frame that can be sent")


@needs_root
def test_a_transmit_queue_that_is_full_costs_little_and_is_told(bus: Bus, peer: can.BusABC) -> None:
    bus.open()
    peer.send(frame(0x701, b"\5"))
    wait_for(lambda: bus.state == "ok", "the first frame")
    with contextlib.ExitStack() as stack:
        shape = ["tc", "qdisc", "add", "dev", "vcan1", "root", "tbf", "rate", "8kbit", "burst", "16", "limit", "64"]
        subprocess.run(shape, check=True)
        stack.callback(subprocess.run, ["tc", "qdisc", "del", "dev", "vcan1", "root"], check=True)
        taken, worst = 0, 0.0
        for _ in range(100):
            bus.begin()
            before = time.monotonic()
            taken += sum(bus.send(frame(0x201 + node)) for node in range(10))
            worst = max(worst, time.monotonic() - before)
            if bus.state == "gone":
                break
    assert bus.counters["send_failures"] > 0
    assert taken < 100
    assert worst < LATE
    wait_for(lambda: bus.counters["opened"] >= 2, "reopening")


@needs_root
def test_frames_of_can_fd_pass_both_ways_beside_classic_ones() -> None:
    ip("set", "vcan1", "down")
    ip("set", "vcan1", "mtu", "72", "up")
    heard: list[bytes] = []
    wide = can.Message(
        arbitration_id=0x200, data=bytes(range(64)), is_fd=True, bitrate_switch=True, is_extended_id=False
    )
    bus = Bus("can1", BusConfig(interface="socketcan", channel="vcan1", data_bitrate=5_000_000), SystemClock())
    bus.subscribe(0x181, lambda data, received: heard.append(bytes(data)))
    try:
        bus.open()
        wait_for(lambda: bus.counters["opened"], "the interface")
        subprocess.run(["cansend", "vcan1", "181##1" + "A5" * 48], check=True)
        subprocess.run(["cansend", "vcan1", "181#0102"], check=True)
        wait_for(lambda: len(heard) == 2, "both frames")
        with can.Bus(interface="socketcan", channel="vcan1", fd=True) as peer:
            wait_for(lambda: bus.send(wide), "the frame")
            message = peer.recv(LIMIT)
    finally:
        bus.close()
    assert heard == [b"\xa5" * 48, b"\x01\x02"]
    assert message is not None
    assert (bytes(message.data), message.is_fd, message.bitrate_switch) == (bytes(range(64)), True, True)
