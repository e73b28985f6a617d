import struct

import pytest
from bench import CELL, DRIVE, ENCODER, SPECS, bench

from simulators.nodes.canopen.node import Nmt
from simulators.nodes.canopen.objects import Abort

MASTER = 127
OPERATIONAL, STOPPED, PRE_OPERATIONAL = b"\x05", b"\x04", b"\x7f"


def heartbeats(frames, node):
    return [data for identifier, data in frames if identifier == 0x700 + node]


def test_every_node_reports_once_when_it_boots():
    with bench() as b:
        assert sorted(b.heard) == [(0x700 + spec.node, b"\0") for spec in SPECS]


def test_producer_heartbeat_keeps_its_time_and_tells_the_state():
    with bench() as b:
        assert b.write(CELL, 0x1017, 0, "H", 100) == 0
        frames = b.step(2.0, pieces=400)
        assert heartbeats(frames, CELL) == [PRE_OPERATIONAL] * 20
        assert heartbeats(frames, DRIVE) == []
        for command, state in ((1, OPERATIONAL), (2, STOPPED), (0x80, PRE_OPERATIONAL)):
            b.nmt(command)
            assert heartbeats(b.step(0.5, pieces=100), CELL) == [state] * 5


def test_a_stall_is_not_made_up_for_by_a_burst_of_heartbeats():
    with bench() as b:
        b.write(CELL, 0x1017, 0, "H", 10)
        assert len(heartbeats(b.step(1.0), CELL)) == 1
        assert 9 <= len(heartbeats(b.step(0.1, pieces=20), CELL)) <= 11


def test_a_stopped_node_does_not_answer_sdo():
    with bench() as b:
        b.nmt(2, CELL)
        assert b.send(0x600 + CELL, struct.pack("<BHB4x", 0x40, 0x1000, 0)) == []
        assert b.read(DRIVE, 0x1000, 0, "I") == 0x20192
        b.nmt(0x80, CELL)
        assert b.read(CELL, 0x1000, 0, "I") == 0x20194


def test_reset_node_restores_everything_and_boots():
    with bench() as b:
        b.write(ENCODER, 0x6000, 0, "H", 1)
        b.write(ENCODER, 0x1017, 0, "H", 50)
        assert b.nmt(0x81, ENCODER) == [(0x700 + ENCODER, b"\0")]
        assert b.read(ENCODER, 0x6000, 0, "H") == 0
        assert b.read(ENCODER, 0x1017, 0, "H") == 0


def test_reset_communication_keeps_the_application():
    with bench() as b:
        b.write(ENCODER, 0x6000, 0, "H", 1)
        b.write(ENCODER, 0x1017, 0, "H", 50)
        b.nmt(1)
        assert (0x700 + ENCODER, b"\0") in b.nmt(0x82, ENCODER)
        assert b.rig.node("hinge_encoder").nmt is Nmt.PRE_OPERATIONAL
        assert b.read(ENCODER, 0x6000, 0, "H") == 1
        assert b.read(ENCODER, 0x1017, 0, "H") == 0


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x01\x00\x00", b"\x55\x00"])
def test_malformed_nmt_changes_nothing(data):
    with bench() as b:
        b.send(0, data)
        assert b.sync() == {}


def watch(b, node, milliseconds=150):
    return b.write(node, 0x1016, 1, "I", MASTER << 16 | milliseconds)


def beat(b):
    return b.send(0x700 + MASTER, OPERATIONAL)


def test_a_lost_master_is_reported_once_and_only_after_it_was_heard():
    with bench() as b:
        assert watch(b, CELL) == 0
        b.nmt(1)
        assert b.step(1.0, pieces=100) == []
        for _ in range(5):
            beat(b)
            assert b.step(0.14, pieces=14) == []
        frames = b.step(1.0, pieces=100)
        emergencies = [data for identifier, data in frames if identifier == 0x80 + CELL]
        assert [struct.unpack_from("<HB", data) for data in emergencies] == [(0x8130, 0x11)]
        assert b.read(CELL, 0x1001, 0, "B") == 0x11
        assert b.read(CELL, 0x1003, 0, "B") == 1
        assert b.read(CELL, 0x1003, 1, "I") == 0x8130


@pytest.mark.parametrize(("behaviour", "state"), [(0, Nmt.PRE_OPERATIONAL), (1, Nmt.OPERATIONAL), (2, Nmt.STOPPED)])
def test_error_behaviour_after_a_lost_master(behaviour, state):
    with bench() as b:
        watch(b, CELL)
        b.write(CELL, 0x1029, 1, "B", behaviour)
        b.nmt(1)
        beat(b)
        b.step(0.3, pieces=30)
        assert b.rig.node("wire_cell").nmt is state


def test_two_masters_are_watched_and_one_is_not_watched_twice():
    with bench() as b:
        assert watch(b, CELL) == 0
        assert b.write(CELL, 0x1016, 2, "I", MASTER << 16 | 500) == Abort.INCOMPATIBLE
        assert b.write(CELL, 0x1016, 2, "I", 126 << 16 | 50) == 0
        beat(b)
        b.send(0x700 + 126, OPERATIONAL)
        frames = b.step(0.1, pieces=20)
        assert [identifier for identifier, _ in frames] == [0x80 + CELL]


def test_watching_can_be_switched_off():
    with bench() as b:
        watch(b, CELL)
        beat(b)
        assert b.write(CELL, 0x1016, 1, "I", 0) == 0
        assert b.step(1.0, pieces=100) == []


def test_the_error_history_is_cleared_by_writing_zero():
    with bench() as b:
        b.rig.fault("emcy wire_cell")
        b.rig.fault("emcy wire_cell")
        assert b.read(CELL, 0x1003, 0, "B") == 2
        assert b.write(CELL, 0x1003, 0, "B", 0) == 0
        assert b.read(CELL, 0x1003, 0, "B") == 0
        assert b.read(CELL, 0x1003, 1, "I") == 0
