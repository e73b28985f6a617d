"""The wire that can be broken, by itself."""

import itertools

import can
import pytest

from hal.protocols.can_frames import FD_SIZES
from simulators.wire_faults import BUS_OFF, Chances, FaultyWire

_numbers = itertools.count()


class Ends:
    """A HAL's end and a node's end of a wire."""

    def __init__(self, seed=0):
        near, far = (f"wire_faults_{next(_numbers)}_{side}" for side in ("near", "far"))
        self.hal, self.node = (can.Bus(interface="virtual", channel=channel) for channel in (near, far))
        inner = [can.Bus(interface="virtual", channel=channel) for channel in (near, far)]
        self.wire = FaultyWire(*inner, seed=seed)

    def to_hal(self, frames, now=0.0):
        """What arrives of frames that a node sends."""
        for identifier, data in frames:
            self.node.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        self.wire.to_hal(now)
        return self.heard(self.hal)

    def to_nodes(self, frames, now=0.0):
        for identifier, data in frames:
            self.hal.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        self.wire.to_nodes(now)
        return self.heard(self.node)

    def heard(self, bus):
        found = []
        while (message := bus.recv(0)) is not None:
            found.append((message.arbitration_id, bytes(message.data)))
        return found


@pytest.fixture
def ends():
    made = []

    def make(seed=0):
        made.append(Ends(seed))
        return made[-1]

    yield make
    for one in made:
        one.wire.close()
        one.hal.shutdown()
        one.node.shutdown()


FRAMES = [(0x181, bytes([number % 256, 1, 2, 3])) for number in range(400)]


def test_a_whole_wire_passes_everything_in_order(ends):
    wire = ends()
    assert wire.to_hal(FRAMES) == FRAMES
    assert wire.to_nodes(FRAMES) == FRAMES


def test_a_seed_loses_the_same_frames_each_time_and_another_seed_others(ends):
    lost = []
    for seed in (1, 1, 2):
        wire = ends(seed)
        wire.wire.chances = Chances(loss=0.2)
        lost.append(wire.to_hal(FRAMES))
    assert lost[0] == lost[1] != lost[2]
    assert 0.1 * len(FRAMES) < len(FRAMES) - len(lost[0]) < 0.3 * len(FRAMES)


def test_what_happens_to_one_identifier_does_not_depend_on_the_others(ends):
    alone, crowded = ends(), ends()
    others = [frame for pair in zip(FRAMES, ((0x581, b""),) * len(FRAMES), strict=True) for frame in pair]
    for wire in (alone, crowded):
        wire.wire.chances = Chances(loss=0.3)
    kept = [frame for frame in crowded.to_hal(others) if frame[0] == 0x181]
    assert kept == alone.to_hal(FRAMES)


def test_lengths_bytes_and_copies_change_as_told(ends):
    wire = ends()
    wire.wire.chances = Chances(short=1.0)
    assert all(len(data) < 4 for _, data in wire.to_hal(FRAMES))
    wire.wire.chances = Chances(long=1.0)
    assert all(4 < len(data) <= 8 for _, data in wire.to_hal(FRAMES))
    wire.wire.chances = Chances(corrupt=1.0)
    found = wire.to_hal(FRAMES)
    assert all(sum(a != b for a, b in zip(f[1], g[1], strict=True)) == 1 for f, g in zip(found, FRAMES, strict=True))
    assert wire.to_nodes(FRAMES) == FRAMES
    wire.wire.chances = Chances(duplicate=1.0)
    assert wire.to_hal(FRAMES[:2]) == [FRAMES[0], FRAMES[0], FRAMES[1], FRAMES[1]]


def test_a_late_frame_comes_when_it_is_due_behind_younger_ones(ends):
    wire = ends()
    wire.wire.chances = Chances(delay=1.0, delayed_by=0.01)
    assert wire.to_hal(FRAMES[:1], 0.0) == []
    wire.wire.chances = Chances()
    assert wire.to_hal(FRAMES[1:2], 0.005) == FRAMES[1:2]
    assert wire.to_hal([], 0.01) == FRAMES[:1]


def test_a_node_can_have_another_id_or_that_of_somebody_else(ends):
    wire = ends()
    wire.wire.readdressed = {2: 1}
    assert wire.to_hal([(0x182, b"a"), (0x702, b"b"), (0x181, b"c")]) == [(0x181, b"a"), (0x701, b"b"), (0x181, b"c")]
    assert wire.to_nodes([(0x201, b"a"), (0x202, b"b"), (0x080, b""), (0x000, b"\x01\x02")]) == [
        (0x202, b"a"),
        (0x201, b"a"),
        (0x080, b""),
        (0x000, b"\x01\x02"),
    ]


def test_a_cut_wire_and_a_lost_identifier_pass_nothing(ends):
    wire = ends()
    wire.wire.lost = frozenset({0x081})
    assert wire.to_hal([(0x081, b""), (0x181, b"")]) == [(0x181, b"")]
    wire.wire.is_cut = True
    assert wire.to_hal(FRAMES) == wire.to_nodes(FRAMES) == []


def test_error_frames_and_babble_reach_the_hal(ends):
    wire = ends()
    wire.wire.error(BUS_OFF)
    error = wire.hal.recv(0)
    assert error.is_error_frame
    assert error.arbitration_id == BUS_OFF
    wire.wire.babble = lambda draw: [(0x123, draw.randbytes(2))] * 5
    assert [identifier for identifier, _ in wire.to_hal([])] == [0x123] * 5


def test_a_broken_frame_of_can_fd_has_a_length_that_there_is(ends):
    wire = ends()
    wire.wire.chances = Chances(short=0.5, long=0.5, corrupt=0.5)
    wire.wire.readdressed = {1: 2}
    for _ in range(200):
        wire.node.send(can.Message(arbitration_id=0x181, data=bytes(24), is_fd=True, is_extended_id=False))
    wire.wire.to_hal(0.0)
    messages = [wire.hal.recv(0) for _ in range(200)]
    assert all(message.is_fd and message.arbitration_id == 0x182 for message in messages)
    sizes = {len(message.data) for message in messages}
    assert sizes <= set(FD_SIZES) and min(sizes) < 24 < max(sizes)
