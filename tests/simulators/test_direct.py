"""The world as hal devices without a bus, under the real Robot."""

from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from hal.device import DeviceState
from simulators.direct import DirectDevice, WorldClock
from simulators.robots.musashi_arm import random_motion, simulator

CONFIG = load_robot(Path(__file__).parents[2] / "robots" / "musashi_arm.yaml")


@pytest.fixture
def parts():
    world = simulator.world("geometric", 0)
    clock = WorldClock(world)
    device = DirectDevice(CONFIG, world, clock)
    yield world, clock, device
    device.close()
    world.close()


def test_sleeping_is_stepping(parts):
    world, clock, _ = parts
    start, stamp = clock.monotonic(), clock.now_ns()
    clock.sleep_until(start + 0.0125)
    assert clock.monotonic() == start + 0.0125
    assert clock.now_ns() == stamp + 12_500_000
    assert world.time == pytest.approx(0.0125)
    clock.sleep_until(start)
    assert world.time == pytest.approx(0.0125)


def test_readings_are_in_the_robots_order_and_of_now(parts):
    world, clock, device = parts
    device.open()
    clock.sleep_until(clock.monotonic() + 0.1)
    reading = device.read()
    assert device.measures == tuple(CONFIG.element_names())
    assert reading.values == pytest.approx(np.concatenate(list(world.truth().values())))
    assert np.all(reading.received == clock.monotonic())


def test_it_moves_only_while_enabled(parts):
    world, clock, device = parts
    start = world.truth()["muscle_length"]

    def after(command: np.ndarray) -> np.ndarray:
        device.apply(command)
        clock.sleep_until(clock.monotonic() + 0.2)
        return world.truth()["muscle_length"] - start

    device.open()
    assert device.health().state is DeviceState.READY
    assert after(start + 0.01) == pytest.approx(np.zeros(10), abs=1e-6)
    device.enable()
    assert device.health().state is DeviceState.ENABLED
    assert after(start + 0.01) == pytest.approx(np.full(10, 0.01), abs=1e-4)
    device.disable()
    assert after(start) == pytest.approx(np.full(10, 0.01), abs=1e-4)
    device.close()
    device.close()
    assert device.health().state is DeviceState.CLOSED


def test_a_robot_follows_random_motion_in_simulated_time():
    robot = simulator.direct(CONFIG, "actual", 0)
    motion = random_motion(CONFIG, 0)
    clock = robot.clock
    with robot:
        sample, _ = robot.cycle()
        robot.enable()
        tick = clock.monotonic()
        modes = set()
        remaining = 0.0
        for _ in range(600):
            if remaining <= 0.0:
                command, remaining = next(motion)
            tick += robot.period
            remaining -= robot.period
            clock.sleep_until(tick)
            sample, applied = robot.cycle()
            modes.add(applied.mode)
            if robot.mode in ("hold", "follow"):
                robot.command(command, sample.cycle)
        assert sample.source == "simulated"
        assert sample.complete
        assert modes <= {"enabling", "hold", "follow"}
        assert all(valid.all() for valid in sample.valid.values())
        assert np.abs(applied.values - sample.values["muscle_length"]).max() < 0.005
        assert applied.mode == "follow"
