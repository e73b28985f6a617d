"""When a frame came, told from wall-clock stamps, whatever becomes of the wall clock."""

import random
import threading
import time

import can
import pytest

from hal.clock import ManualClock, SystemClock
from hal.config import BusConfig
from hal.wire.bus import Bus
from hal.wire.stamps import DOUBT, FrameClock
from hal.wire.state import FROZEN

DELAY = 0.0003
LIMIT = 10.0


@pytest.fixture
def clock():
    clock = ManualClock()
    clock.set_wall(1.7e9)
    return clock


def stamp(clock, ago=0.0):
    return clock.now_ns() * 1e-9 - ago


def test_a_frame_is_as_old_as_its_stamp(clock):
    frames = FrameClock(clock)
    for _ in range(100):
        clock.advance(0.005)
        assert frames.received(stamp(clock, DELAY), clock.monotonic()) == pytest.approx(
            clock.monotonic() - DELAY, abs=1e-6
        )
    assert not any(frames.counters.values())


@pytest.mark.parametrize("waited", [0.006, 0.3, 3.0, 100.0])
def test_a_frame_that_waited_while_we_were_frozen_is_told_as_old_as_it_is(clock, waited):
    frames = FrameClock(clock)
    clock.advance(waited)
    assert frames.received(stamp(clock, waited), clock.monotonic()) == pytest.approx(
        clock.monotonic() - waited, abs=1e-6
    )
    assert frames.counters == {"waited": 1, "clock_steps": 0, "bad_stamps": 0}


@pytest.mark.parametrize("step", [-3600.0, -1.0, -0.05, -0.02, 0.02, 0.05, 1.0, 3600.0])
def test_setting_the_wall_clock_makes_no_frame_newer_or_older(clock, step):
    frames = FrameClock(clock)
    for _ in range(100):
        clock.advance(0.005)
        frames.received(stamp(clock, DELAY), clock.monotonic())
    before = stamp(clock, DELAY)
    clock.set_wall(1.7e9 + step)
    for number, report in enumerate((before, before, *[None] * 100)):  # two were stamped before, and read after
        now = clock.monotonic()
        received = frames.received(stamp(clock, DELAY) if report is None else report, now)
        assert received == pytest.approx(now - DELAY, abs=1e-6), number
        if report is None:
            clock.advance(0.001)
    assert frames.counters["clock_steps"] == 1
    assert frames.counters["bad_stamps"] == 0


def test_a_small_step_is_noticed_within_the_period_of_looking(clock):
    frames = FrameClock(clock)
    clock.set_wall(1.7e9 - 0.003)
    worst = 0.0
    for _ in range(100):
        clock.advance(0.005)
        now = clock.monotonic()
        worst = max(worst, now - frames.received(stamp(clock, DELAY), now))
    assert worst < 0.0035
    assert frames.counters["clock_steps"] == 1
    assert frames.received(stamp(clock, DELAY), clock.monotonic()) == pytest.approx(clock.monotonic() - DELAY, abs=1e-6)


def test_slewing_is_no_step(clock):
    frames = FrameClock(clock)
    for number in range(10_000):
        clock.advance(0.005)
        clock.set_wall(1.7e9 + 0.0005 * 0.005 * number)
        now = clock.monotonic()
        assert frames.received(stamp(clock, DELAY), now) == pytest.approx(now - DELAY, abs=1e-4)
    assert frames.counters["clock_steps"] == 0


def test_a_stamp_in_the_future_is_not_believed(clock):
    frames = FrameClock(clock)
    clock.advance(10 * DOUBT)
    assert frames.received(stamp(clock, -0.5), clock.monotonic()) == clock.monotonic()
    assert frames.counters["bad_stamps"] == 1


class SlowClock(ManualClock):
    """Reading it takes time, as where the kernel has to be asked."""

    COST = 0.0001
    reads = 0

    def monotonic(self):
        self.reads += 1
        self.advance(self.COST)
        return super().monotonic()


def test_where_reading_a_clock_is_slow_late_frames_do_not_have_it_read_every_time():
    clock = SlowClock()
    clock.set_wall(1.7e9)
    frames = FrameClock(clock)
    before = clock.reads
    for _ in range(100):
        clock.advance(0.0001)
        now = clock.monotonic()
        assert frames.received(stamp(clock, 0.008), now) == pytest.approx(now - 0.008, abs=5e-4)
    assert clock.reads - before < 300
    assert frames.counters["bad_stamps"] == 0


def test_no_frame_is_ever_newer_than_now(clock):
    frames = FrameClock(clock)
    chance = random.Random(5)
    for _ in range(5_000):
        clock.advance(chance.choice((0.0, 0.001, 0.02, 1.0)))
        if chance.random() < 0.01:
            clock.set_wall(1.7e9 + chance.uniform(-10, 10))
        now = clock.monotonic()
        assert frames.received(stamp(clock, chance.choice((0.0, DELAY, 0.01, -0.01, -3.0, 1e9))), now) <= now


def test_frames_without_stamps_that_waited_are_told_as_old_as_they_can_be(tmp_path):
    bus = Bus("can0", BusConfig(interface="virtual", channel=str(tmp_path)), SystemClock())
    hold, ages = threading.Event(), []

    def handler(data, received):
        if data == b"first":
            hold.wait(LIMIT)
        else:
            ages.append((bytes(data), time.monotonic() - received))

    def send(data, count):
        peer.send(can.Message(arbitration_id=0x181, data=data, is_extended_id=False))
        deadline = time.monotonic() + LIMIT
        while len(ages) < count:
            assert time.monotonic() < deadline
            time.sleep(0.001)

    bus.subscribe(0x181, handler)
    bus.open()
    with can.Bus(interface="virtual", channel=str(tmp_path)) as peer:
        send(b"fresh", 1)
        send(b"first", 1)
        for _ in range(5):
            send(b"waits", 1)
        time.sleep(1.5 * FROZEN)
        hold.set()
        time.sleep(0.1)
        send(b"new", 7)
    bus.close()
    report = dict(ages)
    assert report[b"fresh"] < FROZEN
    assert all(age > FROZEN for data, age in ages if data == b"waits")
    assert report[b"new"] < FROZEN
    assert bus.health()["counters"]["waited"] == 5
    assert bus.health()["stamps"] == "arrival"
