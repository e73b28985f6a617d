import random
import time

import can
import pytest

from hal.protocols.can_frames import FD_SIZES, fd_bits
from simulators.hub import HubBus, HubServer
from simulators.wire_time import EXTENDED, REMOTE, Wire, arbitration, fd_frame_bits, frame_bits


def frame_bits_by_the_book(identifier, data, length):
    """ISO 11898-1 written out bit by bit: an oracle that shares no table with the real one."""
    remote = bool(identifier & REMOTE)
    if identifier & EXTENDED:
        text = f"0{identifier >> 18 & 0x7FF:011b}11{identifier & 0x3FFFF:018b}{remote:d}00{length:04b}"
    else:
        text = f"0{identifier & 0x7FF:011b}{remote:d}00{length:04b}"
    text += "" if remote else "".join(f"{byte:08b}" for byte in data)
    crc = 0
    for bit in text:
        invert = int(bit) ^ crc >> 14
        crc = crc << 1 & 0x7FFF
        crc ^= 0x4599 if invert else 0
    sent = ""
    for bit in text + f"{crc:015b}":
        sent += bit
        if sent[-5:] in ("00000", "11111"):
            sent += "1" if bit == "0" else "0"
    return len(sent) + 1 + 2 + 7 + 3


def test_frame_length_equals_the_standard_written_out():
    chance = random.Random(1)
    for _ in range(3000):
        length = chance.randrange(9)
        data = bytes(chance.choice((0, 0xFF, chance.randrange(256))) for _ in range(length))
        kind = chance.choice((0, REMOTE, EXTENDED, EXTENDED | REMOTE))
        identifier = chance.randrange(1 << 29 if kind & EXTENDED else 1 << 11) | kind
        if kind & REMOTE:
            data = b""
        assert frame_bits(identifier, data, length) == frame_bits_by_the_book(identifier, data, length)


def fd_frame_bits_by_the_book(identifier, data):
    """ISO 11898-1:2015 written out bit by bit: lengths at the two bit rates; the checksum's values do not matter."""
    if identifier & EXTENDED:
        head = f"0{identifier >> 18 & 0x7FF:011b}11{identifier & 0x3FFFF:018b}0101"
    else:
        head = f"0{identifier & 0x7FF:011b}00101"
    body = f"0{FD_SIZES.index(len(data)):04b}" + "".join(f"{byte:08b}" for byte in data)
    sent, at_bus = "", 0
    for number, bit in enumerate(head + body):
        sent += bit
        if sent[-5:] in ("00000", "11111"):
            sent += "1" if bit == "0" else "0"
        if number + 1 == len(head):
            at_bus = len(sent)
    checksum = 4 + (21 if len(data) > 16 else 17)
    fixed = len(range(0, checksum, 4))  # one before the stuff count, and one behind every four bits
    return at_bus + 1 + 2 + 7 + 3, len(sent) - at_bus + checksum + fixed


def test_length_of_a_frame_of_can_fd_equals_the_standard_written_out():
    chance = random.Random(2)
    for _ in range(3000):
        data = bytes(chance.choice((0, 0xFF, chance.randrange(256))) for _ in range(chance.choice(FD_SIZES)))
        kind = chance.choice((0, EXTENDED))
        identifier = chance.randrange(1 << 29 if kind else 1 << 11) | kind
        parts = fd_frame_bits(identifier, data)
        assert parts == fd_frame_bits_by_the_book(identifier, data)
        assert sum(parts) <= sum(fd_bits(len(data), bool(kind)))


def test_a_long_frame_ends_sooner_if_its_data_are_sent_at_a_higher_bit_rate():
    ends = []
    for data_bitrate in (1_000_000, 5_000_000):
        wire = Wire(1_000_000, data_bitrate)
        wire.push_fd(0.0, "a", 0x100, bytes(range(64)), b"")
        ends.append(wire.due() if wire.advance(0.0) == [] else None)
    at_bus, at_data = fd_frame_bits(0x100, bytes(range(64)))
    assert ends == pytest.approx([(at_bus + at_data) * 1e-6, at_bus * 1e-6 + at_data * 0.2e-6])


@pytest.mark.parametrize("length", range(9))
def test_frame_length_lies_between_no_and_worst_stuffing(length):
    chance = random.Random(length)
    plain = 47 + 8 * length
    for _ in range(300):
        bits = frame_bits(chance.randrange(2048), chance.randbytes(length))
        assert plain <= bits <= plain + (34 + 8 * length - 1) // 4


def test_arbitration_is_won_by_the_dominant_bit():
    order = [0x000, 0x080, 0x123, 0x123 | REMOTE, EXTENDED | 0x123 << 18, EXTENDED | 0x123 << 18 | 1, 0x124]
    assert sorted(order, key=arbitration) == order


def push(wire, now, name, identifier):
    wire.push(now, name, identifier, bytes(8), 8, name.encode())


def test_the_lowest_identifier_goes_first_and_no_frame_is_interrupted():
    wire = Wire(1_000_000)
    push(wire, 0.0, "high", 0x700)
    assert wire.advance(0.0) == []
    push(wire, 10e-6, "middle", 0x300)
    push(wire, 20e-6, "low", 0x100)
    bits = [frame_bits(identifier, bytes(8)) for identifier in (0x700, 0x100, 0x300)]
    ends = [sum(bits[: count + 1]) * 1e-6 for count in range(3)]
    done = wire.advance(1.0)
    assert [name for name, _, _ in done] == ["high", "low", "middle"]
    assert [end for _, _, end in done] == pytest.approx(ends)
    assert wire.busy == pytest.approx(ends[-1])
    assert wire.due() is None


def test_an_idle_bus_starts_when_the_frame_comes_and_tells_when_it_ends():
    wire = Wire(125_000)
    push(wire, 5.0, "a", 0x1)
    assert wire.advance(5.0) == []
    end = 5.0 + frame_bits(0x1, bytes(8)) / 125_000
    assert wire.due() == pytest.approx(end)
    assert wire.advance(end - 1e-6) == []
    assert [name for name, _, _ in wire.advance(end)] == ["a"]


def test_frames_with_one_identifier_keep_their_order():
    wire = Wire(1_000_000)
    for name in "abcdef":
        push(wire, 0.0, name, 0x10)
    assert [name for name, _, _ in wire.advance(1.0)] == list("abcdef")


def test_a_timed_hub_takes_at_least_the_time_of_the_bits(tmp_path):
    channel = str(tmp_path / "bus.can")
    frames = [(0x180 + number % 100, number.to_bytes(8, "big")) for number in range(1000)]
    seconds = sum(frame_bits(identifier, data) for identifier, data in frames) * 1e-6
    with HubServer(channel, 1_000_000) as server, HubBus(channel) as a, can.Bus(interface="hub", channel=channel) as b:
        start = time.monotonic()
        a.send_frames(frames)
        got = [b.recv(20) for _ in frames]
        assert time.monotonic() - start >= seconds
        assert server.stats()["busy"] == pytest.approx(seconds)
    assert sorted(bytes(frame.data) for frame in got) == [data for _, data in frames]
    stamps = [frame.timestamp for frame in got]
    assert stamps[-1] - stamps[0] >= 0.9 * seconds


def test_on_a_timed_hub_an_urgent_frame_overtakes(tmp_path):
    channel = str(tmp_path / "bus.can")
    with HubServer(channel, 20_000) as _, HubBus(channel) as a, HubBus(channel) as b, HubBus(channel) as listener:
        a.send_frames([(0x700, bytes(8))] * 20)
        listener.recv(20)
        b.send_frames([(0x080, b"")])
        order = [listener.recv(20).arbitration_id for _ in range(20)]
    assert order.index(0x080) <= 3


def test_a_program_that_fills_its_queue_does_not_keep_others_from_the_arbitration(tmp_path):
    channel = str(tmp_path / "bus.can")
    with HubServer(channel, 20_000) as server, HubBus(channel) as babbler, HubBus(channel) as b, HubBus(channel) as ear:
        babbler.send_frames([(0x700, bytes(8))] * 1000)
        ear.recv(20)
        assert server.stats()["frames"] < 1000  # the rest waits in the socket
        b.send_frames([(0x080, b"")])
        order = [ear.recv(20).arbitration_id for _ in range(20)]
    assert order.index(0x080) <= 3


def test_a_timed_hub_that_is_overloaded_holds_its_senders_back(tmp_path):
    channel = str(tmp_path / "bus.can")
    with HubServer(channel, 10_000) as server, HubBus(channel) as bus:
        start = time.monotonic()
        with pytest.raises(can.CanOperationError, match="overloaded"):
            for _ in range(100):
                bus.send_frames([(0x100, bytes(8))] * 128, timeout=0.0)
        sent = (time.monotonic() - start) * 10_000 / frame_bits(0x100, bytes(8))
        assert server.stats()["frames"] <= 256 + 127 + sent + 1
