"""A made-up body on the bench: sensors follow the drives in the same way with and without a bus, and can be learned."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from on_bench import arrives, cycle_until, virtual
from test_bench_dbc import SENSOR

from hal.config import RobotConfig
from hal.robot import open_robot
from simulators.rig import Rig
from simulators.robots.bench import body, hardware
from simulators.robots.bench.made_up import BenchBody

ROOT = Path(__file__).parents[2]
PLANAR = """
robot: planar
signals:
  motor_position: {unit: rad, elements: [a, b]}
  motor_velocity: {unit: rad/s, elements: [a, b]}
  motor_effort: {unit: N m, elements: [a, b]}
  joint_position: {unit: rad, elements: [a, b]}
  force: {unit: N, elements: [tip, side], stale_after: 0.5}
  heat: {unit: degC, elements: [tip], stale_after: 0.5}
  angle: {unit: rad, elements: [tip], stale_after: 0.5}
command: {signal: motor_position, hold: 1.0}
limits: {motor_position: {low: -0.5, high: 0.7, rate: 2.0}}
rates: {hal: 100}
buses: {can0: {interface: hub, channel: planar}}
kinds:
  drive: {driver: cia402, settings: {eds: EDS/servo_drive.eds, counts_per_turn: 4096, gear: 50}}
  encoder: {driver: cia406, settings: {eds: EDS/joint_encoder.eds, counts_per_turn: 262144}}
  cell: {driver: cia404, settings: {eds: EDS/load_cell.eds, preset: float32}}
  unit: {driver: dbc, settings: {dbc: unit.dbc, silent_after: 2.0, periods: {Load: 0.02, Pages: 0.02}, quantities: {
    force: {signal: Load.Force}, heat: {signal: Load.Heat}, angle: {signal: Pages.Angle, scale: 0.017453}}}}
devices:
  drive_a: {kind: drive, bus: can0, node: 1, elements: {
    position: motor_position.a, velocity: motor_velocity.a, effort: motor_effort.a}}
  drive_b: {kind: drive, bus: can0, node: 2, elements: {
    position: motor_position.b, velocity: motor_velocity.b, effort: motor_effort.b}}
  encoder_a: {kind: encoder, bus: can0, node: 31, element: joint_position.a}
  encoder_b: {kind: encoder, bus: can0, node: 32, element: joint_position.b}
  cell: {kind: cell, bus: can0, node: 51, element: force.side}
  unit: {kind: unit, bus: can0, node: 91, elements: {force: force.tip, heat: heat.tip, angle: angle.tip}}
"""


@pytest.fixture
def config(tmp_path: Path) -> RobotConfig:
    (tmp_path / "unit.dbc").write_text(SENSOR)
    text = PLANAR.replace("EDS", str(ROOT / "robots" / "eds"))
    return virtual(yaml.safe_load(text) | {"folder": tmp_path})


def driven(world: BenchBody, config: RobotConfig, goals: np.ndarray) -> None:
    """Let the servos of the commanded elements reach their goals."""
    for element, goal in zip(config.signals["motor_position"].elements, goals.tolist(), strict=True):
        world.drive(f"motor_position.{element}", goal, True)
    for _ in range(200):
        world.step(0.005)


def test_nodes_on_a_bus_measure_the_same_body_as_the_world(config: RobotConfig) -> None:
    goal = np.array([0.6, 0.6])
    world = BenchBody(config, hardware(config), seed=0)
    driven(world, config, goal)
    truth = world.truth()
    rig = body.rig(config, "bench", 0)
    rig.start()
    try:
        with open_robot(config) as robot:
            cycle_until(robot, arrives("motor_position", goal, 1e-3), goal)
            for _ in range(30):  # the slowest message of the unit comes
                robot.clock.sleep_until(robot.clock.monotonic() + robot.period)
                sample, _ = robot.cycle()
                robot.command(goal, sample.cycle)
    finally:
        rig.stop()
    tolerances = {"joint_position": 0.01, "force": [60.0, 0.5], "heat": 2.0, "angle": 0.01, "motor_velocity": 0.05}
    for signal, tolerance in tolerances.items():
        assert (np.abs(sample.values[signal] - truth[signal]) < tolerance).all(), signal
    largest = 0.1 * 50  # N m
    assert sample.values["motor_effort"] == pytest.approx(truth["motor_effort"], abs=0.02 * largest)
    assert (np.abs(truth["motor_effort"]) > 0.05 * largest).any()


def test_every_sensor_follows_the_drives_within_its_range(config: RobotConfig) -> None:
    world = BenchBody(config, hardware(config), seed=0)
    rows = []
    for goals in np.random.default_rng(3).uniform([-0.5, -0.5], [0.7, 0.7], (200, 2)):
        driven(world, config, goals)
        truth = world.truth()
        rows.append(
            np.concatenate([truth[name] for name in ("motor_position", "joint_position", "force", "heat", "angle")])
        )
    table = np.array(rows)
    assert (table.std(axis=0) > 0.05 * np.abs(table).max(axis=0)).all()
    positions, sensors = table[:, :2], table[:, 2:]
    design = np.column_stack([np.ones(len(table)), sensors])
    fit = np.linalg.lstsq(design[:150], positions[:150], rcond=None)[0]
    error = np.sqrt(np.mean((design[150:] @ fit - positions[150:]) ** 2, axis=0))
    assert (error < 0.25 * positions.std(axis=0)).all()  # most of both positions is in the sensors


def test_velocities_are_those_of_the_positions(config: RobotConfig) -> None:
    world = BenchBody(config, hardware(config), seed=0)
    world.drive("motor_position.a", 0.7, True)
    before = world.truth()["motor_position"]
    world.step(0.01)
    truth = world.truth()
    assert truth["motor_velocity"] == pytest.approx((truth["motor_position"] - before) / 0.01)
    assert truth["motor_velocity"][0] > 1.0
    assert truth["motor_velocity"][1] == 0.0


def test_a_seed_changes_the_noise_and_the_actual_body_but_not_the_designers(config: RobotConfig) -> None:
    def force(variant: str, seed: int) -> float:
        robot = body.direct(config, variant, seed)
        world = robot.clock._world
        driven(world, config, np.array([0.5, 0.5]))
        return float(world.truth()["force"][0])

    assert force("bench", 1) == force("bench", 2)
    assert force("actual", 1) == force("actual", 1)
    assert force("actual", 1) != force("actual", 2)
    assert force("actual", 1) == pytest.approx(force("bench", 1), abs=1000.0)  # N, of a range of 8000
    world = BenchBody(config, hardware(config), seed=1)
    assert world.measure()["force"][0] != world.measure()["force"][0]
    assert world.measure()["motor_position"][0] == world.measure()["motor_position"][0]


@pytest.mark.long
def test_a_servo_on_a_line_reports_the_load_that_the_body_has(tmp_path: Path) -> None:
    settings = {"allow_no_watchdog": True, "direction": -1}
    device = {"kind": "servo", "bus": "arm", "node": 1, "elements": {"position": "angle.a", "load": "load.a"}}
    config = virtual({
        "robot": "line",
        "signals": {"angle": {"unit": "rad", "elements": ["a"]}, "load": {"unit": "1", "elements": ["a"]}},
        "command": {"signal": "angle", "hold": 1.0},
        "limits": {"angle": {"low": -1.0, "high": 1.0, "rate": 2.0}},
        "rates": {"hal": 50},
        "buses": {"arm": {"interface": "serial", "channel": "line"}},
        "kinds": {"servo": {"driver": "feetech", "settings": settings}},
        "devices": {"servo": device},
    })  # fmt: skip
    goal = np.array([0.7])
    world = BenchBody(config, hardware(config), seed=0)
    world.drive("angle.a", 0.7, True)
    for _ in range(200):
        world.step(0.005)
    rig = body.rig(config, "bench", 0)
    rig.start()
    try:
        with open_robot(config) as robot:
            sample = cycle_until(robot, arrives("angle", goal, 0.01), goal)
    finally:
        rig.stop()
    load = world.truth()["load"][0]
    assert abs(load) > 0.1
    assert sample.values["load"][0] == pytest.approx(load, abs=0.03)


def test_a_sensor_that_was_set_keeps_its_value(config: RobotConfig) -> None:
    rig = Rig(config, BenchBody(config, hardware(config), seed=0), hardware(config))
    rig.fault("set force.tip 17")
    world = rig._world
    driven(world, config, np.array([0.4, 0.4]))
    assert world.measure()["force"][0] == 17.0
    assert world.truth()["joint_position"][0] != 0.0
