import struct

import pytest
from bench import CELL, DRIVE, ENCODER, bench

from simulators.nodes.canopen.objects import Abort

OFF = 1 << 31


@pytest.fixture
def running():
    with bench() as b:
        b.nmt(1)
        yield b


def tpdo(b, node, *, kind=1, timer=0):
    """Set transmission type and event timer of TPDO 1."""
    assert b.write(node, 0x1800, 2, "B", kind) == 0
    assert b.write(node, 0x1800, 5, "H", timer) == 0


def test_every_node_answers_sync_once_with_its_default_mapping(running):
    answers = running.send(0x80)
    assert sorted(identifier for identifier, _ in answers) == [0x180 + DRIVE, 0x180 + CELL, 0x180 + ENCODER]
    assert {identifier: len(data) for identifier, data in answers} == {0x183: 8, 0x18D: 5, 0x197: 6}


def test_no_process_data_before_the_nodes_are_started():
    with bench() as b:
        assert b.sync() == {}
        b.nmt(1, CELL)
        assert set(b.sync()) == {0x180 + CELL}


def test_inputs_are_sampled_at_sync(running):
    running.world.tension = 30.0
    running.step(0.005)
    value, status = struct.unpack("<iB", running.sync()[0x180 + CELL])
    assert (value, status) == (3150, 0)


def test_set_points_wait_for_sync(running):
    running.send(0x200 + DRIVE, struct.pack("<Hi", 6, 1234))
    assert running.read(DRIVE, 0x607A, 0, "i") == 0
    running.sync()
    assert running.read(DRIVE, 0x607A, 0, "i") == 1234
    assert running.read(DRIVE, 0x6040, 0, "H") == 6


def test_only_the_newest_set_point_before_a_sync_counts(running):
    for target in (1, 2, 3):
        running.send(0x200 + DRIVE, struct.pack("<Hi", 6, target))
    running.sync()
    assert running.read(DRIVE, 0x607A, 0, "i") == 3


def test_an_event_driven_rpdo_acts_at_once(running):
    running.write(DRIVE, 0x1400, 2, "B", 255)
    running.send(0x200 + DRIVE, struct.pack("<Hi", 6, 77))
    assert running.read(DRIVE, 0x607A, 0, "i") == 77


def test_a_short_rpdo_is_reported_and_not_applied(running):
    frames = dict(running.send(0x200 + DRIVE, b"\x06\x00\x01"))
    assert struct.unpack_from("<HB", frames[0x80 + DRIVE]) == (0x8210, 0x11)
    running.sync()
    assert running.read(DRIVE, 0x6040, 0, "H") == 0


def test_a_long_rpdo_is_taken_as_far_as_it_is_mapped(running):
    running.send(0x200 + DRIVE, struct.pack("<HiH", 6, 5, 9))
    running.sync()
    assert running.read(DRIVE, 0x607A, 0, "i") == 5


def test_rpdo_values_out_of_range_are_not_taken(running):
    running.write(DRIVE, 0x1401, 1, "I", OFF | 0x303)
    running.write(DRIVE, 0x1601, 1, "I", 0x60600008)
    running.write(DRIVE, 0x1601, 0, "B", 1)
    running.write(DRIVE, 0x1401, 1, "I", 0x303)
    running.send(0x303, b"\x03")
    running.sync()
    assert running.read(DRIVE, 0x6060, 0, "b") == 0
    running.send(0x303, b"\x08")
    running.sync()
    assert running.read(DRIVE, 0x6060, 0, "b") == 8


def test_every_third_sync(running):
    tpdo(running, CELL, kind=3)
    answered = [0x180 + CELL in running.sync() for _ in range(9)]
    assert answered == [False, False, True] * 3


def test_type_zero_answers_a_sync_only_after_a_change(running):
    tpdo(running, CELL, kind=0)
    assert 0x180 + CELL in running.sync()
    assert 0x180 + CELL not in running.sync()
    running.world.tension += 1.0
    running.step(0.005)
    assert 0x180 + CELL in running.sync()


def test_event_timer(running):
    tpdo(running, CELL, kind=255, timer=20)
    frames = running.step(0.2, pieces=40)
    assert 9 <= sum(identifier == 0x180 + CELL for identifier, _ in frames) <= 11
    assert 0x180 + CELL not in running.sync()


def test_a_pdo_that_is_switched_off_is_silent_and_deaf(running):
    running.write(DRIVE, 0x1800, 1, "I", OFF | 0x183)
    running.write(DRIVE, 0x1400, 1, "I", OFF | 0x203)
    running.send(0x203, struct.pack("<Hi", 6, 5))
    assert 0x183 not in running.sync()
    assert running.read(DRIVE, 0x607A, 0, "i") == 0


def test_identifiers_can_move(running):
    running.write(DRIVE, 0x1800, 1, "I", OFF | 0x183)
    assert running.write(DRIVE, 0x1800, 1, "I", 0x199) == 0
    running.write(DRIVE, 0x1400, 1, "I", OFF | 0x203)
    assert running.write(DRIVE, 0x1400, 1, "I", 0x219) == 0
    running.send(0x219, struct.pack("<Hi", 6, 5))
    answers = running.sync()
    assert 0x199 in answers
    assert 0x183 not in answers
    assert running.read(DRIVE, 0x607A, 0, "i") == 5


STATES = [
    ("identifier of a live PDO", 0x1800, 1, "I", 0x199, Abort.VALUE),
    ("identifier of a service", 0x1801, 1, "I", 0x583, Abort.VALUE),
    ("29-bit identifier", 0x1801, 1, "I", 0x2000_0283, Abort.VALUE),
    ("reserved transmission type", 0x1800, 2, "B", 250, Abort.VALUE),
    ("inhibit time of a live PDO", 0x1800, 3, "H", 10, Abort.DEVICE_STATE),
    ("number of objects of a live PDO", 0x1A00, 0, "B", 0, Abort.DEVICE_STATE),
    ("entry of a live PDO", 0x1A00, 1, "I", 0x10010008, Abort.DEVICE_STATE),
    ("object that does not exist", 0x1A01, 1, "I", 0x5FFF0008, Abort.NO_OBJECT),
    ("object that is no process data", 0x1A01, 1, "I", 0x10170010, Abort.NOT_MAPPABLE),
    ("object of another length", 0x1A01, 1, "I", 0x60410020, Abort.MAPPING_LENGTH),
    ("read-only object to be received", 0x1601, 1, "I", 0x60410010, Abort.NOT_MAPPABLE),
    ("number of objects without objects", 0x1A01, 0, "B", 1, Abort.MAPPING_LENGTH),
    ("more than eight objects", 0x1A01, 0, "B", 9, Abort.TOO_HIGH),
]


@pytest.mark.parametrize("case", STATES, ids=[case[0] for case in STATES])
def test_pdo_rules(running, case):
    _, index, sub, form, value, code = case
    assert running.write(DRIVE, index, sub, form, value) == code


def test_more_than_eight_bytes_cannot_be_mapped(running):
    for sub, number in enumerate((0x60640020, 0x606C0020, 0x60410010), 1):
        assert running.write(DRIVE, 0x1A01, sub, "I", number) == 0
    assert running.write(DRIVE, 0x1A01, 0, "B", 3) == Abort.MAPPING_LENGTH
    assert running.write(DRIVE, 0x1A01, 0, "B", 2) == 0
    assert running.write(DRIVE, 0x1A01, 3, "I", 0x60410010) == Abort.DEVICE_STATE
