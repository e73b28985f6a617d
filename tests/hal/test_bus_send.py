"""Sending: bounded, never queued, and told."""

import errno
import os
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import can
import pytest
from can.interfaces import BACKENDS
from can.interfaces.virtual import VirtualBus

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.protocols.can_frames import CLASSIC
from hal.wire.bus import Bus
from hal.wire.kernel import IN_FLIGHT, set_buffers
from hal.wire.send import FAILED_SENDS, PAUSE, PAUSES, Sender
from hal.wire.state import BusState

LIMIT = 10.0


class Interface(VirtualBus):
    """An interface of a foreign make whose `send` does what the test says: raises, blocks, or takes the frame."""

    trouble: Exception | None = None
    """Raised by every send."""
    room: int | None = None
    """Frames that are still taken; then the transmit queue is full."""
    is_stuck = threading.Event()
    taken: list = []  # noqa: RUF012
    tries = 0

    def send(self, msg, timeout=None):
        kind = type(self)
        kind.tries += 1
        while kind.is_stuck.is_set() and self._open:
            time.sleep(0.005)
        if not self._open:
            raise OSError(errno.EBADF, "closed")
        if kind.trouble is not None:
            raise kind.trouble
        if kind.room is not None:
            if kind.room == 0:
                raise can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS)
            kind.room -= 1
        kind.taken.append((msg.arbitration_id, bytes(msg.data)))
        super().send(msg, timeout)


@pytest.fixture
def interface(monkeypatch):
    monkeypatch.setitem(BACKENDS, "virtual", (__name__, "Interface"))
    Interface.trouble, Interface.room, Interface.taken, Interface.tries = None, None, [], 0
    Interface.is_stuck.clear()
    return Interface


@pytest.fixture
def bus(interface, tmp_path):
    bus = Bus("can0", BusConfig(interface="virtual", channel=str(tmp_path)), SystemClock())
    bus.open()
    yield bus
    interface.is_stuck.clear()
    bus.close()


def frame(identifier=0x201, data=b"\x0f\x00"):
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def wait_for(condition, what):
    deadline = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.005)


def test_a_full_interface_costs_a_cycle_so_many_pauses_and_no_more(bus, interface):
    bus.begin()
    interface.room = 3
    assert [bus.send(frame(0x201 + node)) for node in range(10)] == [True] * 3 + [False] * 7
    assert interface.tries == 10 + PAUSES
    bus.begin()
    interface.room = None
    assert all(bus.send(frame(0x201 + node)) for node in range(10))
    assert bus.counters["send_failures"] == 7


def test_what_was_not_sent_in_its_cycle_is_never_sent(bus, interface):
    for cycle in range(3):
        bus.begin()
        interface.room = 0 if cycle == 1 else None
        for node in range(3):
            bus.send(frame(0x201 + node, bytes([cycle])))
    assert interface.taken == [(0x201 + node, bytes([cycle])) for cycle in (0, 2) for node in range(3)]


def test_a_full_interface_that_makes_room_within_the_pauses_takes_the_frame(bus, interface):
    bus.begin()
    interface.room = 0
    threading.Timer(3 * PAUSE, lambda: setattr(interface, "room", 1)).start()
    assert bus.send(frame(), patience=LIMIT)
    assert interface.taken == [(0x201, b"\x0f\x00")]


@pytest.mark.parametrize(
    "trouble",
    [
        can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN),
        can.CanOperationError("Failed to transmit: No such device", errno.ENODEV),
        BrokenPipeError(errno.EPIPE, "Broken pipe"),
        AssertionError("only requested a single extra field"),
        ValueError("file descriptor cannot be a negative integer (-1)"),
        AttributeError("'NoneType' object has no attribute 'send'"),
    ],
    ids=lambda error: type(error).__name__ + str(getattr(error, "error_code", "")),
)
@pytest.mark.long
def test_whatever_sending_raises_is_counted_told_and_no_reason_to_wait(bus, interface, trouble):
    interface.trouble = trouble
    bus.begin()
    assert [bus.send(frame()) for _ in range(FAILED_SENDS + 2)] == [False] * (FAILED_SENDS + 2)
    assert interface.tries == FAILED_SENDS
    assert bus.counters["send_failures"] == FAILED_SENDS + 2
    wait_for(lambda: bus.counters["opened"] >= 2, "reopening")
    assert bus.state is BusState.GONE
    interface.trouble = None
    wait_for(lambda: bus.send(frame()), "an interface that sends")


def test_one_identifier_that_never_goes_out_is_enough_to_open_again(bus, interface):
    for _ in range(FAILED_SENDS):
        bus.begin()
        interface.room = 1
        assert bus.send(frame(0x201))
        assert not bus.send(frame(0x202))
    wait_for(lambda: bus.counters["opened"] >= 2, "reopening")


def test_nothing_is_sent_while_the_controller_is_off_the_bus(bus, interface):
    with can.Bus(interface="virtual", channel=bus._config.channel) as peer:
        peer.send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))
        wait_for(lambda: bus.state is BusState.BUS_OFF, "bus-off")
        bus.begin()
        assert not bus.send(frame())
        peer.send(can.Message(arbitration_id=0x100, is_error_frame=True, data=bytes(8)))
        peer.send(frame(0x701, b"\x05"))
        wait_for(lambda: bus.state is BusState.OK, "restarted")
        assert bus.send(frame(data=b"new"))
    assert (0x201, b"\x0f\x00") not in interface.taken
    assert bus.counters["opened"] == 1


@pytest.mark.long
def test_an_interface_that_hangs_while_sending_is_shut_and_opened_again(bus, interface):
    interface.is_stuck.set()
    bus.begin()
    sending = threading.Thread(target=bus.send, args=(frame(),))
    sending.start()
    wait_for(lambda: interface.tries, "the frame that hangs")
    assert not bus.send(frame(0x202)), "another thread does not hang with it"
    sending.join(LIMIT)
    assert not sending.is_alive()
    interface.is_stuck.clear()
    wait_for(lambda: bus.counters["opened"] >= 2 and bus.send(frame()), "reopening")


def test_an_interface_is_not_blocked_while_the_whole_machine_stands_still(bus, interface, monkeypatch):
    sender = Sender({"sent": 0, "send_failures": 0}, print, CLASSIC)
    sender.use(bus._can)
    interface.is_stuck.set()
    sending = threading.Thread(target=sender.send, args=(frame(),))
    sending.start()
    wait_for(lambda: interface.tries, "the frame that hangs")
    clock = SimpleNamespace(monotonic=time.monotonic, sleep=time.sleep)
    monkeypatch.setattr("hal.wire.send.time", clock)
    start, problems = time.monotonic(), []
    for later in (0.0, 5.0, 5.1, 6.5, *(7.0 + 0.1 * look for look in range(12))):
        clock.monotonic = lambda later=later: start + later
        problems.append(sender.problem())
    assert not any(problems[:4])
    assert "has not returned" in problems[-1]
    monkeypatch.undo()
    interface.is_stuck.clear()
    sending.join(LIMIT)


def test_a_frame_that_is_too_long_is_refused_and_no_fault_of_the_interface(bus, interface):
    report = []
    sender = Sender({"sent": 0, "send_failures": 0}, report.append, CLASSIC)
    sender.use(bus._can)
    for _ in range(2 * FAILED_SENDS):
        assert not sender.send(frame(data=bytes(9)))
    assert interface.tries == 0
    assert not sender.problem()
    assert report[0] == "Frame 201h has 9 data bytes; a classic frame has at most 8."


def test_what_canopen_sends_raises_nothing_and_may_wait(bus, interface):
    interface.room = 0
    threading.Timer(0.01, lambda: setattr(interface, "room", 1)).start()
    bus.network.send_message(0x601, bytes(8))
    assert [identifier for identifier, _ in interface.taken] == [0x601]
    bus.close()
    bus.network.send_message(0x601, bytes(8))


class OfFile:
    """As much of an interface as tells which file it uses."""

    def __init__(self, handle):
        self._handle = handle

    def fileno(self):
        if self._handle is None:
            raise NotImplementedError
        return self._handle


def test_a_socket_has_room_for_what_comes_and_little_for_what_goes():
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with here, there:
        small = here.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        set_buffers(OfFile(here.fileno()))
        assert here.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) > small
        taken, before = 0, time.monotonic()
        with pytest.raises(BlockingIOError):  # though the socket is a blocking one
            while time.monotonic() - before < LIMIT:
                here.send(bytes(16))
                taken += 1
        assert 0.5 * IN_FLIGHT <= taken <= 2 * IN_FLIGHT


@pytest.mark.parametrize("handle", [None, -1, "pipe"])
def test_what_is_no_socket_is_left_alone_and_nothing_leaks(handle):
    ends = os.pipe()
    before = len(list(Path("/proc/self/fd").iterdir()))
    set_buffers(OfFile(ends[0] if handle == "pipe" else handle))
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    for end in ends:
        os.close(end)


def test_while_another_thread_hands_over_a_frame_a_cycle_waits_for_a_turn_and_no_more(bus, interface):
    interface.is_stuck.set()
    other = threading.Thread(target=bus.send, args=(frame(0x603),))
    other.start()
    wait_for(lambda: interface.tries == 1, "the other thread sends")
    for _ in range(FAILED_SENDS + 1):
        bus.begin()
        assert [bus.send(frame(0x201 + node)) for node in range(3)] == [False] * 3
    interface.is_stuck.clear()
    other.join()
    bus.begin()
    assert bus.send(frame())
    assert bus.counters["opened"] == 1, "a busy machine is no reason to open the interface again"
    assert [identifier for identifier, _ in interface.taken] == [0x603, 0x201]
