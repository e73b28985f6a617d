import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid

import can
import pytest

from simulators import hub_server
from simulators.hub import HubBus, HubServer
from simulators.hub_socket import IS_FD, RECORD, RECORD_FD, channels, socket_path


@pytest.fixture
def channel(tmp_path):
    return str(tmp_path / "bus.can")


def join(channel, **options):
    return can.Bus(interface="hub", channel=channel, **options)


def message(identifier, data=b"", **flags):
    return can.Message(arbitration_id=identifier, data=data, **{"is_extended_id": False, **flags})


def wait_until(condition, patience=10.0):
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def test_frames_reach_everybody_else_unchanged(channel):
    sent = [
        message(0x181, b"\x01\x02"),
        message(0x7FF),
        message(0x1ABCDEF0, bytes(8), is_extended_id=True),
        message(0x605, is_remote_frame=True, dlc=8),
        message(0x40, bytes(8), is_error_frame=True),
    ]
    with HubServer(channel), join(channel) as a, join(channel) as b, join(channel) as c:
        for frame in sent:
            a.send(frame)
        for bus in (b, c):
            for frame in sent:
                got = bus.recv(5)
                assert got.equals(frame, timestamp_delta=None, check_channel=False)
                assert abs(got.timestamp - time.time()) < 60
        assert a.recv(0) is None


def test_own_messages_come_back_when_asked_for(channel):
    with HubServer(channel), join(channel, receive_own_messages=True) as bus:
        bus.send(message(5))
        assert bus.recv(5).arbitration_id == 5


def test_filters_and_timeouts(channel):
    with HubServer(channel), join(channel) as a, join(channel) as b:
        b.set_filters([{"can_id": 0x80, "can_mask": 0x7FF}])
        a.send(message(0x100))
        a.send(message(0x80))
        assert b.recv(5).arbitration_id == 0x80
        assert b.recv(0.01) is None


def test_a_burst_of_frames_fits_several_packets(channel):
    frames = [(number % 2048, number.to_bytes(2, "big")) for number in range(1000)]
    with HubServer(channel), HubBus(channel) as a, join(channel) as b:
        a.send_frames(frames)
        got = [b.recv(5) for _ in frames]
    assert [(frame.arbitration_id, bytes(frame.data)) for frame in got] == frames


@pytest.mark.parametrize(
    "frame",
    [message(1, bytes(12), is_fd=True), message(0x800), message(1, dlc=9), message(1 << 29, is_extended_id=True)],
)
def test_what_is_no_classic_frame_is_refused(channel, frame):
    with HubServer(channel), join(channel) as bus, pytest.raises(can.CanOperationError):
        bus.send(frame)


def test_twenty_thousand_frames_from_another_process_all_arrive_in_order(channel):
    sender = (
        "import can, sys\n"
        "with can.Bus(interface='hub', channel=sys.argv[1]) as bus:\n"
        "    bus.recv()\n"
        "    for number in range(20000):\n"
        "        bus.send(can.Message(arbitration_id=0x100, data=number.to_bytes(8, 'big'), is_extended_id=False))\n"
        "    bus.recv()\n"
    )
    with HubServer(channel) as server, join(channel) as bus:
        process = subprocess.Popen([sys.executable, "-c", sender, channel])
        wait_until(lambda: server.stats()["clients"] == 2, 30)
        bus.send(message(1))
        numbers = []
        while len(numbers) < 20000:
            frame = bus.recv(20)
            assert frame is not None, f"only {len(numbers)} frames came"
            numbers.append(int.from_bytes(frame.data, "big"))
        bus.send(message(1))
        assert process.wait(20) == 0
    assert numbers == list(range(20000))


def test_opening_without_a_server_fails_at_once_and_says_what_to_check():
    with pytest.raises(can.CanInitializationError, match="No server has the hub channel 'no_such_bus'"):
        join("no_such_bus")


@pytest.mark.parametrize(("channel", "complaint"), [("../x", "not the name of a hub"), ("x" * 120, "longer than")])
def test_names_that_cannot_be_sockets_are_refused(channel, complaint):
    with pytest.raises(can.CanInitializationError, match=complaint):
        socket_path(channel)


def test_a_second_server_is_refused_and_the_first_goes_on(channel):
    with HubServer(channel), join(channel) as a, join(channel) as b:
        with pytest.raises(can.CanInitializationError, match="already served"):
            HubServer(channel).start()
        a.send(message(7))
        assert b.recv(5).arbitration_id == 7


def test_a_closed_server_leaves_no_file_and_can_start_again(tmp_path, channel):
    server = HubServer(channel)
    for _ in range(2):
        with server, join(channel):
            pass
        server.close()
        assert list(tmp_path.iterdir()) == []


def test_killed_hub_is_noticed_and_its_stale_socket_is_replaced(tmp_path, channel):
    code = (
        "import sys, time; from simulators.hub import HubServer; HubServer(sys.argv[1]).start(); "
        "print('ready', flush=True); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, channel], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"ready\n"
    with join(channel) as bus:
        process.kill()
        process.communicate()
        with pytest.raises(can.CanOperationError, match="gone"):
            bus.recv(20)
        with pytest.raises(can.CanOperationError, match="gone"):
            bus.send(message(1))
        with pytest.raises(can.CanInitializationError):
            join(channel)
    assert socket_path(channel).exists()
    with HubServer(channel), join(channel) as a, join(channel) as b:
        a.send(message(9))
        assert b.recv(5).arbitration_id == 9


def test_a_program_that_never_reads_is_cut_off_and_the_others_lose_nothing(channel, monkeypatch):
    monkeypatch.setattr(hub_server, "_BACKLOG", 1000 * RECORD.size)
    numbers = []
    with HubServer(channel) as server, join(channel) as lazy, HubBus(channel) as sender, join(channel) as reader:
        wait_until(lambda: server.stats()["clients"] == 3)
        for number in range(60_000):
            sender.send_frames([(0x100, number.to_bytes(4, "big"))])
            while (frame := reader.recv(0)) is not None:
                numbers.append(int.from_bytes(frame.data, "big"))
        while len(numbers) < 60_000:
            numbers.append(int.from_bytes(reader.recv(10).data, "big"))
        assert server.stats()["cut_off"] == 1
        assert server.stats()["clients"] == 2
        with pytest.raises(can.CanOperationError, match="cut this program off"):
            while lazy.recv(1) is not None:
                pass
    assert numbers == list(range(60_000))


def test_a_client_that_speaks_another_language_is_dropped(channel):
    with HubServer(channel) as server, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
        stranger.connect(channel)
        stranger.send(b"GET / HTTP/1.1")
        wait_until(lambda: server.stats()["malformed"] == 1)
        assert server.stats()["clients"] == 0


def test_a_client_with_a_frame_of_can_fd_of_a_length_that_there_is_not_is_dropped(channel):
    with (
        HubServer(channel, 1_000_000, 4_000_000) as server,
        HubBus(channel) as bus,
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger,
    ):
        stranger.connect(channel)
        stranger.send(RECORD_FD.pack(0x123, 9 | IS_FD, 0.0, bytes(9)))
        wait_until(lambda: server.stats()["malformed"] == 1)
        bus.send(can.Message(arbitration_id=0x123, data=bytes(12), is_fd=True, is_extended_id=False))
        wait_until(lambda: server.stats()["clients"] == 1 and server.stats()["frames"] == 2)


def test_a_program_that_leaves_is_forgotten(channel):
    with HubServer(channel) as server:
        with join(channel):
            wait_until(lambda: server.stats()["clients"] == 1)
        wait_until(lambda: server.stats()["clients"] == 0)
        assert server.stats()["cut_off"] == 0


def test_shutdown_wakes_a_waiting_receiver(channel):
    caught = []
    with HubServer(channel):
        bus = join(channel)

        def receive():
            with contextlib.suppress(can.CanOperationError):
                bus.recv(60)
            caught.append(True)

        thread = threading.Thread(target=receive)
        thread.start()
        time.sleep(0.05)
        bus.shutdown()
        thread.join(10)
        assert caught == [True]
        with pytest.raises(can.CanOperationError, match="closed"):
            bus.send(message(1))
        bus.shutdown()


@pytest.mark.long
def test_python_can_tools_join_by_the_entry_point(channel, tmp_path):
    log = tmp_path / "bus.log"
    logger = [sys.executable, "-m", "can.logger", "-i", "hub", "-c", channel, "-f", str(log)]
    with HubServer(channel) as server, join(channel) as bus:
        process = subprocess.Popen(logger, stdout=subprocess.DEVNULL)
        wait_until(lambda: server.stats()["clients"] == 2, 30)
        for number in range(10):
            bus.send(message(0x123, bytes([number])))
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        process.wait(20)
    assert log.read_text().count("123#") == 10


def test_named_channels_lie_in_the_runtime_folder_and_are_listed(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    name = f"bus_{uuid.uuid4().hex[:8]}"
    with HubServer(name):
        assert socket_path(name) == tmp_path / "gemuco" / f"{name}.can"
        assert channels() == [name]
        assert (tmp_path / "gemuco").stat().st_mode & 0o777 == 0o700
        assert socket_path(name).stat().st_mode & 0o777 == 0o600
        assert {"interface": "hub", "channel": name} in can.detect_available_configs(["hub"])
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert str(os.getuid()) in str(socket_path(name).parent)
