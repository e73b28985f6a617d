"""Packets of servos: the makers' own examples, whatever comes on the line, and the two sides against each other."""

import random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hal.protocols import dynamixel, feetech
from simulators.nodes.serial import dynamixel as other_dynamixel
from simulators.nodes.serial import feetech as other_feetech

MAKES = {"feetech": (feetech, other_feetech), "dynamixel": (dynamixel, other_dynamixel)}
by_make = pytest.mark.parametrize("make", MAKES)


def test_dynamixel_packets_of_the_e_manual():
    """emanual.robotis.com/docs/en/dxl/protocol2: the examples of each instruction."""
    assert dynamixel.ping(1).hex(" ") == "ff ff fd 00 01 03 00 01 19 4e"
    assert dynamixel.read(1, 132, 4).hex(" ") == "ff ff fd 00 01 07 00 02 84 00 04 00 1d 15"
    assert dynamixel.write(1, 116, (512).to_bytes(4, "little")).hex(" ") == (
        "ff ff fd 00 01 09 00 03 74 00 00 02 00 00 ca 89"
    )
    assert dynamixel.reboot(1).hex(" ") == "ff ff fd 00 01 03 00 08 2f 4e"
    assert dynamixel.sync_read([1, 2], 132, 4).hex(" ") == "ff ff fd 00 fe 09 00 82 84 00 04 00 01 02 ce fa"
    # en.robotis.com/service, post 2408140: torque on for ids 1 and 2
    assert dynamixel.write(1, 64, b"\1").hex(" ") == "ff ff fd 00 01 06 00 03 40 00 01 db 66"
    assert dynamixel.write(2, 64, b"\1").hex(" ") == "ff ff fd 00 02 06 00 03 40 00 01 eb 65"


def test_dynamixel_answers_of_the_e_manual():
    reader = dynamixel.reader()
    ping = bytes.fromhex("fffffd000107005500060426655d")
    (status,) = reader.feed(ping)
    assert (status.node, status.error, status.data) == (1, 0, bytes((0x06, 0x04, 0x26)))
    read = bytes.fromhex("fffffd000108005500a60000008cc0")
    (status,) = reader.feed(read)
    assert int.from_bytes(status.data, "little") == 166
    assert reader.malformed == 0


def test_feetech_packets_of_the_manual():
    """Communication Protocol User Manual, examples 1 to 5."""
    assert feetech.ping(1).hex(" ") == "ff ff 01 02 01 fb"
    assert feetech.read(1, 0x38, 2).hex(" ") == "ff ff 01 04 02 38 02 be"
    assert feetech.write(0xFE, 5, b"\1").hex(" ") == "ff ff fe 04 03 05 01 f4"
    goals = {node: bytes.fromhex("00080000e803") for node in (1, 2, 3, 4)}
    assert feetech.sync_write(0x2A, goals).hex(" ") == (
        "ff ff fe 20 83 2a 06 01 00 08 00 00 e8 03 02 00 08 00 00 e8 03 03 00 08 00 00 e8 03 04 00 08 00 00 e8 03 58"
    )
    (status,) = feetech.reader().feed(bytes.fromhex("ffff01040018 05dd".replace(" ", "")))
    assert (status.node, status.error, feetech.number(status.data)) == (1, 0, 0x518)


def test_signs_of_feetech_numbers():
    for value in (0, 1, -1, 4095, -4095, 32767, -32767):
        assert feetech.number(feetech.word(value)) == value
    assert feetech.word(40000) == feetech.word(32767)
    assert feetech.number(bytes.fromhex("0a04"), feetech.LOAD_SIGN) == -10
    assert feetech.number(bytes.fromhex("0a80")) == -10


@by_make
@example(node=1, data=b"\xff\xff\xfd\xfd", cuts=[])
@example(node=1, data=b"\xff\xff\xfd\xff\xff\xfd\xfd\xfd", cuts=[])
@given(node=st.integers(0, 252), data=st.binary(max_size=40), cuts=st.lists(st.integers(1, 12), max_size=30))
def test_what_is_packed_is_unpacked_by_the_other_side(make, node, data, cuts):
    ours, other = MAKES[make]
    stream = bytearray(ours.write(node, 42, data))
    ((identifier, instruction, parameters),) = other.packets(stream)
    assert (identifier, instruction) == (node, 3)
    assert parameters[2 if make == "dynamixel" else 1 :] == data


@by_make
@given(noise=st.binary(max_size=30), data=st.binary(min_size=2, max_size=30), cuts=st.lists(st.integers(1, 9)))
def test_an_answer_is_found_after_noise_and_in_pieces(make, noise, data, cuts):
    """Noise that looks like the beginning of a packet may hide one answer, and never more than the next one."""
    ours, _ = MAKES[make]
    reader = ours.reader()
    packet = _status(make, 7, 0, data)
    stream = noise + 40 * packet
    found = []
    for size in [*cuts, len(stream)]:
        found += reader.feed(stream[:size])
        stream = stream[size:]
    good = [status for status in found if status.node == 7 and status.data == data]
    assert len(good) >= 40 - (1 + 300 // len(packet)), "noise hides more than one packet's length"


@by_make
def test_random_bytes_are_no_measurements(make):
    ours, _ = MAKES[make]
    draw = random.Random(5)
    reader = ours.reader()
    found = [status for _ in range(2000) for status in reader.feed(draw.randbytes(draw.randrange(1, 60)))]
    assert len(found) < 40, "a checksum of one byte lets some through, and no more"
    assert reader.malformed > 0
    assert len(reader._bytes) <= 5000


@by_make
def test_one_wrong_bit_is_noticed(make):
    ours, _ = MAKES[make]
    packet = _status(make, 3, 0, bytes(range(20)))
    for place in range(2, len(packet)):
        for bit in range(8):
            wrong = bytearray(packet)
            wrong[place] ^= 1 << bit
            assert not [s for s in ours.reader().feed(bytes(wrong)) if s.data == bytes(range(20)) and s.node == 3]


def test_what_a_dynamixel_servo_was_sent_is_no_answer():
    reader = dynamixel.reader()
    assert reader.feed(dynamixel.sync_read([1, 2], 132, 4) + dynamixel.ping(3)) == []
    assert reader.malformed == 0


@pytest.mark.parametrize("count", [1, 2, 3])
def test_bytes_that_look_like_a_header_are_stuffed(count):
    data = b"\xff\xff\xfd" * count
    packet = dynamixel.write(1, 116, data)
    assert packet.count(b"\xff\xff\xfd\x00") == 1
    assert dynamixel.reader().feed(_status("dynamixel", 1, 0, data))[0].data == data


def _status(make, node, error, data):
    """A status packet, made by the simulated servo's own code."""
    if make == "feetech":
        body = bytes((node, len(data) + 2, error)) + data
        return b"\xff\xff" + body + bytes((other_feetech.received_sum(body),))
    body = (bytes((0x55, error)) + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    packet = other_dynamixel.HEADER + bytes((node,)) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + other_dynamixel.crc16(packet).to_bytes(2, "little")
