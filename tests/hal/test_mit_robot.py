"""The real robot with drives in MIT mode: measured, enabled, followed and stopped."""

import itertools

import can
import numpy as np
import pytest
from mit_bench import DAMIAO, T_MOTOR, OneJoint, hardware, mit_bench, node, only

from hal.protocols import mit
from hal.protocols.mit import Special
from hal.protocols.mit_motors import MOTORS
from simulators.nodes.mit_drive import MitConstants


@pytest.fixture
def bench(open_mit):
    return open_mit()


def test_everything_is_measured_without_power(bench):
    bench.cycle(2)
    values, valid = bench.sample.values, bench.sample.valid
    assert bench.robot.mode == "off"
    assert values["joint_position"] == pytest.approx([0.4, -0.3, 1.2], abs=25 / 65535)
    assert values["motor_temperature"] == pytest.approx([25.0, 25.0, 25.0])
    assert values["driver_temperature"] == pytest.approx([30.0])
    assert all(valid[name].all() for name in valid)
    assert not any(node(bench, joint).is_on for joint in ("elbow", "wrist", "finger"))
    bench.world.position[:] = [0.5, -0.2, 1.0]
    bench.cycle(2)
    assert bench.sample.values["joint_position"] == pytest.approx([0.5, -0.2, 1.0], abs=25 / 65535)


def test_enabling_moves_nothing(bench):
    bench.cycle(2)
    before = bench.world.position.copy()
    moved = []
    bench.robot.enable()
    for _ in range(60):
        bench.cycle()
        moved.append(np.abs(bench.world.position - before).max())
    assert bench.robot.mode == "hold"
    assert max(moved) < 1e-3
    assert node(bench, "elbow").command.stiffness == pytest.approx(40.0, abs=0.1)


def test_stiffness_grows_within_the_ramp(bench):
    bench.enable()
    grown = []
    for _ in range(25):
        grown.append(node(bench, "elbow").command.stiffness)
        bench.cycle()
    assert grown[0] < 10.0
    assert all(later >= earlier for earlier, later in itertools.pairwise(grown))
    assert grown[-1] == pytest.approx(40.0, abs=0.1)


def test_a_drive_that_remembers_a_command_is_not_moved_by_it():
    bench = mit_bench()
    bench.rig.step(0.0)
    old = mit.COMMAND_LAYOUT.pack(mit.pack(mit.Command(-2.0, 0.0, 300.0, 1.0, 0.0), MOTORS["AK80-9"].ranges))
    for data in (mit.special(Special.ENTER), old):
        bench.wires["can0"].send(can.Message(arbitration_id=2, data=data, is_extended_id=False))
    bench.rig.step(0.0)
    assert node(bench, "wrist").command.stiffness > 299  # the HAL died here, and now it starts again
    bench.open()
    bench.cycle(3)
    before = bench.world.position.copy()
    bench.enable()
    bench.cycle(40)
    assert bench.world.position == pytest.approx(before, abs=2e-3)
    bench.close()


def test_follows(bench):
    bench.enable()
    bench.follow([0.9, -0.8, 1.0], 250)
    assert bench.world.position == pytest.approx([0.9, -0.8, 1.0], abs=2e-3)
    assert bench.sample.values["joint_position"] == pytest.approx([0.9, -0.8, 1.0], abs=3e-3)
    assert bench.sample.complete


def test_velocity_is_measured(bench):
    bench.enable()
    bench.cycle(30)
    target = bench.sample.values["joint_position"].copy()
    for _ in range(60):
        target[0] += 0.01
        bench.follow(target)
    assert bench.sample.values["joint_velocity"][0] == pytest.approx(2.0, abs=0.1)


def test_stiffness_is_that_of_the_joint_behind_its_gear(open_mit):
    settings = {**DAMIAO, "gear": 3.0, "direction": -1, "zero": 0.5, "stiffness": 400.0, "damping": 20.0}
    constants = MitConstants(gear=3.0, direction=-1, zero=0.5, load="joint_effort.elbow")
    world = OneJoint(load=6.0)
    bench = open_mit(*only("elbow", settings, constants), world)
    bench.enable()
    bench.follow([0.0], 200)
    assert world.position[0] == pytest.approx(6.0 / 400.0, rel=0.05)
    assert bench.sample.values["joint_effort"][0] == pytest.approx(-6.0, abs=0.3)


def test_most_effort_is_kept(open_mit):
    settings = {**DAMIAO, "max_effort": 1.5, "ramp": 0.0}
    body, nodes = only("elbow", settings, MitConstants())
    body["limits"] = {"joint_position": {"low": -3.0, "high": 3.0}}
    bench = open_mit(body, nodes, OneJoint())
    bench.enable()
    torques = []
    for _ in range(100):
        bench.follow([2.0])
        torques.append(abs(node(bench, "elbow").torque))
    # The spring pulls with 1.5 N m at most, against a damping of 2 and a friction of 0.1 N m s/rad; it is a little
    # less because the drive moves on until the next frame.
    assert 0.5 < bench.sample.values["joint_velocity"][0] < 1.5 / 2.1
    assert max(torques) < 1.55


def test_damps_on_its_way_to_off(open_mit):
    body, nodes = only("elbow", DAMIAO, MitConstants(load="joint_effort.elbow"), stop={"behaviour": "damp"})
    world = OneJoint(load=4.0)
    bench = open_mit(body, nodes, world)
    bench.enable()
    bench.cycle(10)
    bench.robot.stop("test")
    bench.cycle(60)
    assert bench.robot.mode == "stopping"
    assert node(bench, "elbow").command.stiffness == 0
    # 4 N m against a damping of 2 and a friction of 0.1 N m s/rad
    assert bench.sample.values["joint_velocity"][0] == pytest.approx(4.0 / 2.1, abs=0.05)
    bench.until(lambda: bench.robot.mode == "off", "letting go", 200)
    assert not node(bench, "elbow").is_on


def test_quick_stop_brakes_and_lets_go(bench):
    bench.enable()
    bench.follow([2.0, -0.3, 1.2], 40)
    bench.robot._devices[0].quick_stop()
    bench.cycle(30)
    assert node(bench, "elbow").is_on
    assert (node(bench, "elbow").command.stiffness, node(bench, "elbow").command.damping > 1.9) == (0, True)
    bench.cycle(40)
    assert not node(bench, "elbow").is_on
    assert bench.robot.mode == "fault"


def test_turns_at_a_velocity(open_mit):
    settings = {**DAMIAO, "mode": "velocity"}
    body, nodes = only("elbow", settings, MitConstants())
    body["command"] = {"signal": "joint_velocity", "time_to_live": 0.1, "hold": 0.5}
    body["limits"] = {"joint_velocity": {"low": -5.0, "high": 5.0}}
    bench = open_mit(body, nodes, OneJoint())
    bench.enable()
    bench.follow([3.0], 60)
    # a friction of 0.1 against a damping of 2 N m s/rad
    assert bench.sample.values["joint_velocity"][0] == pytest.approx(3.0 * 2.0 / 2.1, abs=0.05)
    assert node(bench, "elbow").command.stiffness == 0


def test_pulls_with_an_effort(open_mit):
    body, nodes = only("elbow", {**T_MOTOR, "mode": "effort"}, hardware()[1].constants)
    body["command"] = {"signal": "joint_effort", "time_to_live": 0.1, "hold": 0.5}
    body["limits"] = {"joint_effort": {"low": -3.0, "high": 3.0}}
    body["stop"] = {"behaviour": "damp"}
    bench = open_mit(body, nodes, OneJoint())
    bench.enable()
    bench.follow([0.5], 20)
    assert bench.sample.values["joint_effort"][0] == pytest.approx(0.5, abs=0.02)
    assert (node(bench, "elbow").command.stiffness, node(bench, "elbow").command.damping) == (0, 0)


def test_identity_and_inspection(bench):
    devices = {device.name: device for device in bench.robot._devices}
    assert devices["elbow_drive"].identity == f"damiao:{node(bench, 'elbow').spec.serial:08x}"
    assert devices["wrist_drive"].identity == "mit:can0:2:AK80-9"
    found = {}
    bench.while_time_passes(lambda: found.update({name: device.inspect() for name, device in devices.items()}))
    assert all(check.is_good for check in found["elbow_drive"])
    assert {check.what for check in found["elbow_drive"]} >= {"watchdog", "control mode", "velocity range"}
    assert not {check.what: check for check in found["wrist_drive"]}["watchdog"].is_good
