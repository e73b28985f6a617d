"""The robot when a bus goes and comes back: nothing moves by itself, no old set-point goes out, no old value is new."""

import errno
import time

import can
import numpy as np
import pytest
from can.interfaces import BACKENDS
from can.interfaces.virtual import VirtualBus
from hal_bench import Bench

from hal.errors import CommandRefused

LIMIT = 10.0


class Cable(VirtualBus):
    """An interface of a foreign make that can be unplugged: what it raises, or that it says nothing at all."""

    opening = receiving = sending = None
    is_deaf = False

    def __init__(self, *args, **more):
        if type(self).opening is not None:
            raise type(self).opening
        super().__init__(*args, **more)

    def _recv_internal(self, timeout):
        if type(self).receiving is not None:
            raise type(self).receiving
        message, filtered = super()._recv_internal(timeout)
        return (None if type(self).is_deaf else message), filtered

    def send(self, msg, timeout=None):
        if type(self).sending is not None:
            raise type(self).sending
        if not type(self).is_deaf:
            super().send(msg, timeout)


def failure(code, text="Failed"):
    return can.CanOperationError(f"{text}: {errno.errorcode[code]}", code)


WAYS = {
    "adapter unplugged": {
        "opening": OSError(errno.ENODEV, "No such device"),
        "receiving": failure(errno.ENODEV),
        "sending": failure(errno.ENXIO),
    },
    "link down": {"receiving": failure(errno.ENETDOWN), "sending": failure(errno.ENETDOWN)},
    "server died": {"receiving": None, "sending": BrokenPipeError(errno.EPIPE, "Broken pipe"), "is_deaf": True},
    "replugged under the same name": {"is_deaf": True},
    "nobody acknowledges": {"sending": failure(errno.ENOBUFS, "Failed to transmit"), "is_deaf": True},
    "an assertion of the plugin": {"receiving": AssertionError("only requested a single extra field")},
}


@pytest.fixture
def bench(monkeypatch):
    bench = Bench()
    bench.rig.step(0.0)  # the nodes are on the bus by now, and only the HAL's interfaces are such cables
    monkeypatch.setitem(BACKENDS, "virtual", (__name__, "Cable"))
    bench.open()
    yield bench
    plug_in(bench)
    bench.close()


def pull_out(bench, way):
    for name, value in WAYS[way].items():
        setattr(Cable, name, value)
    bench.clock.turn = lambda: bench.rig.step(0.0)  # nobody hears a frame any more, so there is none to wait for


def plug_in(bench):
    Cable.opening = Cable.receiving = Cable.sending = None
    Cable.is_deaf = False
    bench.clock.turn = bench.turn


def is_moving(bench):
    return any(enabled for _, enabled in bench.world.drives.values())


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.long
def test_a_bus_that_goes_and_comes_back_while_the_robot_follows(bench, way):
    bench.enable()
    start = bench.world.length.copy()
    bench.follow(start + 0.002, 3)
    pull_out(bench, way)
    cycles = 0
    while bench.robot.mode != "fault":
        bench.robot.command(start + 0.02, bench.sample.cycle)
        bench.cycle()
        time.sleep(0.001)  # the receive threads have no lockstep without frames
        cycles += 1
        assert cycles * bench.robot.period < 0.25, bench.robot.health()
    with pytest.raises(CommandRefused):
        bench.robot.command(start + 0.02, bench.sample.cycle)
    bench.cycle(60)  # the drives miss the HAL's heartbeat
    assert not any(valid.any() for valid in bench.sample.valid.values())
    assert not is_moving(bench)
    stopped = bench.world.length.copy()
    assert np.abs(stopped - start).max() < 0.02
    opened = {name: bus.counters["opened"] for name, bus in bench.buses.items()}
    failures = {name: bus.counters["failures"] for name, bus in bench.buses.items()}
    deadline = time.monotonic() + LIMIT
    while not all(bus.counters["failures"] > failures[name] for name, bus in bench.buses.items()):
        assert time.monotonic() < deadline, "the buses are not tried again"
        bench.cycle(20)
    assert {bus.state.value for bus in bench.buses.values()} == {"gone"}
    plug_in(bench)
    bench.until(lambda: all(bus.counters["opened"] > opened[name] for name, bus in bench.buses.items()), "reopening")
    bench.until(lambda: bench.states() <= {"ready", "fault"} and bench.sample.complete, "the nodes")
    assert bench.robot.mode == "fault"
    assert not is_moving(bench)
    np.testing.assert_allclose(bench.world.length, stopped, atol=1e-9)
    bench.robot.reset()
    bench.until(lambda: bench.states() == {"ready"}, "reset")
    bench.cycle(20)
    assert not is_moving(bench)
    bench.enable()
    np.testing.assert_allclose(bench.world.length, stopped, atol=1e-5), "enabled where it is"


def test_a_bus_that_was_off_between_two_cycles_stops_the_robot(bench):
    bench.enable()
    bus = bench.buses["can1"]
    now = bench.clock.monotonic()
    off = can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8))
    back = can.Message(arbitration_id=0x100, is_error_frame=True, data=bytes(8))
    bus._handle(off, now)
    bus._handle(back, now)
    assert bus.state == "ok"
    bench.cycle()
    assert bench.robot.mode == "fault"
    assert "Bus 'can1' is bus-off" in bench.robot.fault_text


def test_a_loss_before_the_robot_was_enabled_is_no_reason_to_stop(bench):
    bus = bench.buses["can1"]
    now = bench.clock.monotonic()
    bus._handle(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)), now)
    bus._handle(can.Message(arbitration_id=0x100, is_error_frame=True, data=bytes(8)), now)
    bench.enable()
    bench.cycle(5)
    assert bench.robot.mode == "hold"


def test_a_babbling_stranger_does_not_disturb_the_cycle(bench):
    bench.enable()
    for _ in range(20):
        for _ in range(100):
            bench.send("can0", 0x001, b"12345678")
        bench.cycle()
        assert bench.sample.complete
    assert bench.robot.mode == "hold"
    assert bench.buses["can0"].health()["unknown"] == ["identifier 001h"]


def test_values_of_a_bus_that_is_gone_only_get_older(bench):
    bench.cycle(3)
    pull_out(bench, "replugged under the same name")
    before = -1.0
    for _ in range(30):
        bench.cycle()
        age = bench.sample.age["joint_position"][0]
        assert age > before
        before = age
    assert not bench.sample.valid["joint_position"][0]


@pytest.mark.parametrize("cycles", [10, 25, 60])
def test_answers_that_were_held_up_for_long_are_no_second_node(bench, cycles):
    bench.cycle(5)
    bench.powered = False  # the SYNCs pile up in front of the nodes, which answer them all at once
    bench.cycle(cycles)
    bench.powered = True
    bench.until(lambda: bench.sample.complete, "the nodes")
    bench.cycle(30)
    bench.until(lambda: bench.states() <= {"ready", "fault"}, "the nodes")
    texts = [device["text"] for device in bench.robot.health()["devices"].values()]
    assert not any("twice" in text for text in texts), texts
