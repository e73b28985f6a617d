import random
import struct
import threading
import time

import can
import numpy as np
import pytest
from bench import CELL, DRIVE, ENCODER, SPECS, SpringWorld, bench, config

from simulators.hub import HubServer
from simulators.nodes.canopen.segment import Segment
from simulators.nodes.canopen.spec import CellConstants, NodeSpec
from simulators.rig import Rig, UnknownFault


def wait_for(condition, patience=20.0):
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def test_a_muted_sensor_keeps_its_heartbeat_and_comes_back():
    with bench() as b:
        b.write(ENCODER, 0x1017, 0, "H", 10)
        b.nmt(1)
        sentence = b.rig.fault("sensor_silent hinge_encoder")
        assert sentence == "hinge_encoder (node 23 on can0) sends no measurements any more; its heartbeat goes on."
        assert 0x180 + ENCODER not in b.sync()
        assert (0x700 + ENCODER, b"\x05") in b.step(0.05, pieces=10)
        b.rig.fault("node_back hinge_encoder")
        b.nmt(1)
        assert 0x180 + ENCODER in b.sync()


def test_a_silent_node_says_nothing_at_all():
    with bench() as b:
        b.write(CELL, 0x1017, 0, "H", 10)
        b.nmt(1)
        b.rig.fault("node_silent wire_cell")
        heard = {identifier for identifier, _ in b.step(0.1, pieces=20) + b.nmt(0x81, CELL) + b.nmt(1)}
        assert not heard & {0x700 + CELL, 0x180 + CELL, 0x580 + CELL}
        assert b.send(0x600 + CELL, bytes(8)) == []
        assert b.rig.stats()["nodes"]["wire_cell"] == "off"
        b.rig.fault("node_back wire_cell")
        assert b.step(0.005) == [(0x700 + CELL, b"\0")]


def test_a_reboot_forgets_what_the_master_configured():
    with bench() as b:
        b.write(DRIVE, 0x6060, 0, "b", 8)
        b.rig.fault("node_reboot wire_drive")
        assert b.step(0.005) == [(0x700 + DRIVE, b"\0")]
        assert b.read(DRIVE, 0x6060, 0, "b") == 0
        assert b.rig.stats()["nodes"]["wire_drive"] == "pre_operational"


def test_parts_of_the_world_break_by_their_words():
    with bench() as b:
        assert b.rig.fault("muscle_cut wire") == "Broke muscle_cut wire."
        assert b.world.broken == ["muscle_cut:wire"]


@pytest.mark.parametrize(
    ("text", "known"),
    [
        ("sensor_asleep wire_cell", "sensor_silent NODE"),
        ("sensor_asleep wire_cell", "muscle_cut:wire"),
        ("", "node_reboot NODE"),
        ("node_silent nobody", "wire_drive, wire_cell, hinge_encoder"),
        ("node_silent", "takes the name of one node"),
        ("emcy wire_cell wire_drive", "takes the name of one node"),
    ],
)
def test_an_unknown_fault_lists_what_is_known(text, known):
    with bench() as b, pytest.raises(UnknownFault, match=known):
        b.rig.fault(text)


def test_hardware_that_does_not_fit_the_robot_is_refused():
    for spec, complaint in (
        (NodeSpec("x", "can7", 1, "muscle_tension.wire", CellConstants()), "Known buses: can0"),
        (NodeSpec("x", "can0", 1, "muscle_tension.rope", CellConstants()), "Known elements: joint_position.hinge"),
    ):
        with pytest.raises(ValueError, match=complaint):
            Rig(config(), SpringWorld(), [spec])


def test_truth_and_statistics():
    with bench() as b:
        b.nmt(1)
        b.step(0.05, pieces=10)
        np.testing.assert_array_equal(b.rig.truth()["muscle_tension"], [20.0])
        stats = b.rig.stats()
        assert stats["physics"] == {"steps": 10, "skipped": 0}
        assert stats["buses"]["can0"]["received"] == 1
        assert stats["buses"]["can0"]["sent"] == len(SPECS)
        assert set(stats["nodes"].values()) == {"operational"}
        assert stats["failure"] == ""


@pytest.mark.parametrize(
    ("interface", "options"), [("virtual", {}), ("hub", {}), ("hub", {"options": {"bit_timing": True}})]
)
def test_in_real_time_the_nodes_answer_and_the_world_moves(tmp_path, interface, options):
    channel = str(tmp_path / "bus.can") if interface == "hub" else None
    settings = config(interface, channel, **options)
    world = SpringWorld()
    rig = Rig(settings, world, SPECS)
    rig.start()
    with can.Bus(interface=interface, channel=settings.buses["can0"].channel) as bus:
        bus.send(can.Message(arbitration_id=0, data=[1, 0], is_extended_id=False))
        wait_for(lambda: set(rig.stats()["nodes"].values()) == {"operational"})
        answered = set()
        while len(answered) < 3:
            bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
            while (message := bus.recv(0.1)) is not None:
                answered.add(message.arbitration_id)
        wait_for(lambda: world.time > 0.05)
    rig.stop()
    rig.stop()
    assert world.is_closed
    assert rig.failure == ""


def test_two_rigs_on_one_channel_are_refused(tmp_path):
    settings = config("hub", str(tmp_path / "bus.can"))
    first, second = Rig(settings, SpringWorld(), SPECS), Rig(settings, SpringWorld(), SPECS)
    first.start()
    with pytest.raises(can.CanInitializationError, match="already served"):
        second.start()
    second.stop()
    with can.Bus(interface="hub", channel=settings.buses["can0"].channel):
        first.stop()


def test_a_world_that_fails_silences_the_nodes_and_is_told():
    class Falling(SpringWorld):
        def step(self, duration):
            if self.time > 0.02:
                raise RuntimeError("the world fell apart")
            super().step(duration)

    settings = config()
    rig = Rig(settings, Falling(), SPECS)
    with can.Bus(interface="virtual", channel=settings.buses["can0"].channel) as bus:
        rig.start()
        bus.send(can.Message(arbitration_id=0, data=[1, 0], is_extended_id=False))
        wait_for(lambda: rig.failure)
        time.sleep(0.1)
        while bus.recv(0) is not None:
            pass
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        assert bus.recv(0.1) is None
        assert rig.failure == "physics: the world fell apart"
        rig.stop()


def test_a_bus_that_fails_is_opened_again(tmp_path):
    channel = str(tmp_path / "bus.can")
    settings = config()
    rig = Rig(settings, SpringWorld(), [])
    server = HubServer(channel)
    server.start()
    segment = Segment("can0", SPECS, rig._plant, lambda: can.Bus(interface="hub", channel=channel))
    segment.open(time.monotonic())
    running = threading.Event()
    running.set()
    thread = threading.Thread(target=segment.serve, args=(time.monotonic, running.is_set))
    thread.start()
    server.close()
    with HubServer(channel):
        wait_for(lambda: segment.counters["reopened"] == 1)
        with can.Bus(interface="hub", channel=channel) as bus:
            bus.send(
                can.Message(arbitration_id=0x600 + CELL, data=[0x40, 0, 0x10, 0, 0, 0, 0, 0], is_extended_id=False)
            )
            assert bus.recv(20).arbitration_id == 0x580 + CELL
        running.clear()
        thread.join()
    segment.close()


class EndlessBus(can.BusABC):
    """A bus on which the next frame is there before the last one was answered."""

    def __init__(self):
        super().__init__(channel="endless")
        self.sent = []

    def recv(self, timeout=None):
        return can.Message(arbitration_id=0x123, is_extended_id=False)

    def send(self, msg, timeout=None):
        self.sent.append(msg.arbitration_id)


def test_nodes_that_never_come_to_the_end_of_answering_say_that_they_are_alive():
    rig, bus, now = Rig(config(), SpringWorld(), []), EndlessBus(), 0.0

    def monotonic():
        nonlocal now
        now += 1e-4  # each look at the clock
        return now

    segment = Segment("can0", SPECS, rig._plant, lambda: bus)
    segment.open(0.0)
    segment.nodes["hinge_encoder"].objects.values[0x1017, 0] = 50  # ms
    bus.sent.clear()
    segment.serve(monotonic, lambda: now < 1.0)
    segment.close()
    assert bus.sent.count(0x700 + ENCODER) == pytest.approx(20, abs=3)
    assert segment.counters["received"] > 3000


@pytest.mark.parametrize("seed", range(8))
def test_no_frame_however_malformed_brings_a_node_down(seed):
    chance = random.Random(seed)
    nodes = [spec.node for spec in SPECS]
    with bench() as b:
        objects = sorted(b.rig.node("wire_drive").objects.entries)
        for _ in range(1500):
            data = chance.randbytes(chance.randrange(9))
            identifier = chance.randrange(2048)
            if chance.random() < 0.6:  # a request for an object that exists, with any value
                index, sub = chance.choice(objects)
                head = struct.pack("<BHB", chance.choice((0x23, 0x27, 0x2B, 0x2F, 0x40, 0x21, 0x60)), index, sub)
                identifier, data = 0x600 + chance.choice(nodes), head + chance.randbytes(4)
            elif chance.random() < 0.5:
                identifier = chance.choice((0x000, 0x080, 0x77F, *(0x200 + node for node in nodes)))
            b.send(identifier, data)
            b.step(0.005 * chance.randrange(2))
        b.nmt(0x81)
        b.nmt(1)
        assert set(b.sync()) == {0x180 + node for node in nodes}


def test_frames_of_other_kinds_are_passed_over():
    with bench() as b:
        b.nmt(1)
        for flags in ({"is_remote_frame": True}, {"is_error_frame": True}, {"is_extended_id": True}):
            b.bus.send(can.Message(arbitration_id=0x80, **{"is_extended_id": False, **flags}))
        assert b.step(0.0) == []
