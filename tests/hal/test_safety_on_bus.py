"""Limits and stops with the servo drive on a bus: what the simulated motor really does."""

import threading
import time

import numpy as np
import pytest
from drive_bench import CONSTANTS, ELBOW, JointWorld, joint_description
from hal_bench import Bench

from hal.config import RobotConfig
from simulators.nodes.canopen.spec import NodeSpec

POSITION = {"low": -0.5, "high": 1.0}
LIMITS = {
    "csp": {"joint_position": {**POSITION, "rate": 2.0, "acceleration": 20.0}},
    "csv": {"joint_position": POSITION, "joint_velocity": {"low": -1.5, "high": 1.5, "rate": 10.0}},
    "cst": {
        "joint_position": POSITION,
        "joint_velocity": {"low": -2, "high": 2},
        "joint_effort": {"low": -3, "high": 3},
    },
}


@pytest.fixture
def joint():
    made = []

    def make(mode, stop=None, **settings):
        body = joint_description(mode, **settings)
        for signal in body["signals"].values():
            signal["stale_after"] = 0.02
        body |= {"limits": LIMITS[mode], "stop": stop or body["stop"]}
        spec = NodeSpec("elbow", "can0", 5, ELBOW["position"], CONSTANTS)
        bench = Bench(RobotConfig.model_validate(body), nodes=[spec], world=JointWorld())
        made.append(bench)
        bench.open()
        bench.enable()
        return bench

    yield make
    for bench in made:
        bench.close()


@pytest.mark.parametrize(("mode", "wanted"), [("csp", 9.0), ("csp", -9.0), ("csv", 1.5), ("csv", -1.5)])
@pytest.mark.long
def test_whatever_is_commanded_the_motor_stays_in_its_range(joint, mode, wanted):
    bench = joint(mode)
    places = []
    for _ in range(500):
        bench.follow([wanted])
        places.append(bench.world.position)
    assert min(places) >= -0.5 - 1e-3
    assert max(places) <= 1.0 + 1e-3
    end = 1.0 if wanted > 0 else -0.5
    assert places[-1] == pytest.approx(end, abs=0.03)
    assert bench.robot.mode == "follow"
    assert np.abs(np.diff(places)).max() / bench.robot.period <= 2.0 * 1.1


def test_an_effort_does_not_push_beyond_the_end_and_what_flies_on_is_stopped(joint):
    bench = joint("cst")
    for _ in range(400):
        if bench.robot.mode not in ("hold", "follow"):
            break
        bench.follow([3.0])
    assert bench.world.position < 1.3
    bench.cycle(60)
    where = bench.world.position
    bench.cycle(100)
    assert bench.world.position == pytest.approx(where, abs=1e-6)


@pytest.mark.parametrize("mode", ["csp", "csv", "cst"])
def test_an_emergency_stop_in_motion_is_over_when_the_motor_rests(joint, mode):
    bench = joint(mode)
    bench.follow([{"csp": 0.9, "csv": 1.0, "cst": 0.5}[mode]], 60)
    found = []
    thread = threading.Thread(target=lambda: found.append(bench.robot.estop("a test")))
    thread.start()
    while thread.is_alive():
        bench.cycle()
        time.sleep(0.0005)
    assert found[0].is_complete, found
    where = bench.world.position
    bench.cycle(50)
    assert bench.world.position == pytest.approx(where, abs=1e-6)
    assert not bench.world.enabled
    assert bench.robot.mode == "fault"


def test_parking_over_the_bus(joint):
    bench = joint("csp", stop={"behaviour": "park", "park": [0.1], "speed": 0.5})
    bench.follow([0.9], 60)
    bench.robot.stop("a test")
    bench.until(lambda: bench.robot.mode == "off", "parking", 1000)
    assert bench.world.position == pytest.approx(0.1, abs=1e-3)
    assert not bench.world.enabled


def test_damping_over_the_bus(joint):
    bench = joint("cst", stop={"behaviour": "damp"}, damping=0.5)
    bench.follow([0.5], 60)
    bench.robot.stop("a test")
    bench.until(lambda: bench.robot.mode == "off", "damping", 400)
    assert not bench.world.enabled


def test_one_cycle_without_an_answer_changes_nothing(joint):
    bench = joint("csv")
    bench.follow([0.5], 20)
    bench.clock.turn = lambda: None
    bench.follow([0.5])
    bench.clock.turn = bench.turn
    bench.follow([0.5], 20)
    assert bench.robot.mode == "follow"
    assert bench.applied.values[0] == pytest.approx(0.5)
