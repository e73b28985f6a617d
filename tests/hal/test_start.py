"""Where a robot starts from when it is enabled: from where it really is, not from what one wrong frame says."""

import struct

import numpy as np
import pytest

from hal.config import RobotConfig
from hal.safety.limiter import Limiter
from hal.safety.start import MEMORY, Start

OPERATION_ENABLED, SWITCHED_ON = 0x0237, 0x0233


def forged(statusword, counts):
    return struct.pack("<Hi", statusword, counts)


@pytest.mark.parametrize("cycle", range(8))
@pytest.mark.parametrize("statusword", [SWITCHED_ON, OPERATION_ENABLED])
@pytest.mark.long
def test_a_frame_in_the_name_of_a_drive_moves_nothing_while_it_is_enabled(bench, cycle, statusword):
    bench.cycle(3)
    before = bench.world.length.copy()
    bench.robot.enable()
    bench.cycle(cycle)
    bench.send("can0", 0x181, forged(statusword, 400_000))
    bench.flush()
    for _ in range(30):
        bench.cycle()
        assert bench.world.length == pytest.approx(before, abs=1e-4)  # m


def test_a_drive_that_is_told_to_be_elsewhere_while_it_is_enabled_is_a_fault(bench):
    bench.cycle(3)
    bench.robot.enable()
    bench.world.length[0] += 0.05  # m, an eighth of the range
    bench.cycle(4)
    assert bench.robot.mode == "fault"
    assert "muscle_length.biceps went from 0.3 to 0.35 while the drives were being enabled" in bench.robot.fault_text


def test_a_brake_that_gives_way_a_little_is_no_fault(bench):
    bench.cycle(3)
    bench.robot.enable()
    bench.world.length[0] += 0.01  # m
    bench.until(lambda: bench.robot.mode == "hold", "enabling", 40)


@pytest.mark.parametrize("cycle", range(1, 8))
def test_one_wrong_measurement_while_it_is_enabled_is_not_where_it_starts_from(bench, cycle):
    bench.cycle(3)
    bench.robot.enable()
    bench.cycle(cycle)
    bench.world.length[0] += 0.01  # m, within what a brake may give way
    bench.cycle()
    bench.world.length[0] -= 0.01
    bench.cycle()
    set_points = []
    for _ in range(30):
        _, applied = bench.cycle()
        set_points.append(applied.values[0])
    assert bench.robot.mode == "hold"
    assert set_points == pytest.approx([0.3] * 30, abs=1e-4)  # m


@pytest.mark.filterwarnings("error")
def test_a_drive_that_falls_silent_while_it_is_enabled_does_not_move_the_start():
    config = RobotConfig.model_validate(
        {
            "robot": "arm",
            "signals": {"joint_position": {"unit": "rad", "elements": ["elbow"]}},
            "command": {"signal": "joint_position"},
            "limits": {"joint_position": {"low": -1.0, "high": 1.0, "rate": 1.0}},
        }
    )
    start, limiter = Start(config, "position"), Limiter(config, 0.01)
    start.note({"joint_position": np.array([0.4])}, 0.0)
    limiter.start(start.median())
    start.note({"joint_position": np.array([np.nan])}, 1.1 * MEMORY)
    assert limiter.start(start.median()) == pytest.approx([0.4])  # rad
