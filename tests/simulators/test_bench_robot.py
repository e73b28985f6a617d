"""Any robot file on a bench: nodes made of the file, with nothing behind them."""

import time
from pathlib import Path

import numpy as np
import pytest

from hal.config import RobotConfig, load_robot
from hal.errors import ConfigError
from hal.robot import open_robot
from simulators.faults import UnknownPart
from simulators.robots.bench import simulator
from simulators.robots.bench.world import BenchWorld

ARM = load_robot(Path(__file__).parents[2] / "robots" / "musashi_arm.yaml")


def on_virtual(name: str) -> RobotConfig:
    body = ARM.model_dump(by_alias=True)
    for bus in body["buses"]:
        body["buses"][bus].update(interface="virtual", channel=f"{name}_{bus}")
    return RobotConfig.model_validate(body)


def test_a_servo_is_followed_and_the_rest_stands_still():
    world = BenchWorld(ARM)
    low, high = ARM.bounds("muscle_length")
    world.drive("muscle_length.biceps", 0.35, True)
    world.drive("muscle_length.triceps", 0.29, False)
    world.step(0.5)
    expected = 0.5 * (low + high)
    expected[6] = 0.35
    assert world.truth()["muscle_length"] == pytest.approx(expected, abs=1e-6)  # m


def test_an_element_reads_what_it_is_set_to():
    world = BenchWorld(ARM)
    world.break_part("set:muscle_tension.biceps:50")
    assert world.measure()["muscle_tension"].sum() == 50.0  # N


@pytest.mark.parametrize("part", ["set:muscle_tension.tibialis:1", "set:muscle_tension.biceps:much", "cut:biceps", ""])
def test_what_a_bench_does_not_have_is_told(part):
    with pytest.raises(UnknownPart):
        BenchWorld(ARM).break_part(part)


def test_a_driver_without_another_end_is_told():
    body = ARM.model_dump(by_alias=True)
    body["kinds"]["tension_cell"]["driver"] = "my_lab.cell:Cell"
    with pytest.raises(ConfigError, match="no other end for device 'deltoid_front_cell'"):
        simulator.rig(RobotConfig.model_validate(body), "bench", 0)


def test_a_robot_file_alone_gives_a_robot_that_answers_and_follows():
    config = on_virtual("bench_robot")
    rig = simulator.rig(config, "bench", 0)
    rig.start()
    try:
        with open_robot(config) as robot:
            wanted = np.mean(config.bounds("muscle_length"), axis=0) + 0.01
            there = pytest.approx(wanted, abs=1e-3)  # m
            deadline = time.monotonic() + 30.0
            while time.monotonic() < deadline:
                sample, _ = robot.cycle()
                if robot.mode == "off" and sample.complete and all(valid.all() for valid in sample.valid.values()):
                    robot.enable()
                elif robot.mode in ("hold", "follow"):
                    robot.command(wanted, sample.cycle)
                if sample.values["muscle_length"] == there:
                    break
                robot.clock.sleep_until(robot.clock.monotonic() + robot.period)
            assert sample.values["muscle_length"] == there, robot.health()
    finally:
        rig.stop()
    assert not rig.failure


def test_a_makers_data_sheet_gives_a_device_of_that_maker(tmp_path):
    sheet = (ARM.folder / "eds" / "servo_drive.eds").read_text()
    ours = str(0x47454D55)
    assert ours in sheet
    (tmp_path / "acme.eds").write_text(sheet.replace(ours, str(0xACE0)))
    body = ARM.model_dump(by_alias=True) | {"folder": tmp_path}
    drive = body["devices"]["biceps_drive"]
    for bus in body["buses"]:
        body["buses"][bus].update(interface="virtual", channel=f"makers_{bus}")
    body["kinds"]["muscle_drive"]["settings"]["eds"] = "acme.eds"
    body["devices"] = {"biceps_drive": drive}
    body["signals"] = {"muscle_length": {"unit": "m", "elements": ["biceps"]}}
    body["limits"] = {}
    config = RobotConfig.model_validate(body)
    rig = simulator.rig(config, "bench", 0)
    rig.start()
    try:
        with open_robot(config) as robot:
            assert robot.health()["devices"]["biceps_drive"]["state"] == "ready"
            assert robot._devices[0].identity.startswith("canopen:0000ACE0-00000402-")
    finally:
        rig.stop()
