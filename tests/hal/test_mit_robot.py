"""The real robot with drives in MIT mode: enabled, followed, stopped, broken, silent and back."""

import itertools

import can
import numpy as np
import pytest
from mit_bench import DAMIAO, T_MOTOR, description, elements, hardware, mit_bench

from hal.protocols import mit
from hal.protocols.mit import Special
from hal.protocols.mit_motors import MOTORS
from simulators.nodes.mit_drive import MitConstants
from simulators.nodes.spec import NodeSpec


@pytest.fixture
def bench():
    bench = mit_bench().open()
    yield bench
    bench.close()


@pytest.fixture
def opened():
    """Opens benches of other descriptions, and closes them."""
    benches = []

    def open_bench(config=None, nodes=None, world=None):
        benches.append(mit_bench(config, nodes, world).open())
        return benches[-1]

    yield open_bench
    for bench in benches:
        bench.close()


def only(joint, settings, constants, **changes):
    """A robot with one of the joints, its drive with these settings, and its hardware."""
    body = description(**changes)
    signals = {name: {**signal, "elements": [joint]} for name, signal in body["signals"].items()}
    if settings["motor"].startswith("AK"):
        del signals["driver_temperature"]
    body["signals"] = signals
    device = {"kind": "one", "bus": "can0", "node": 1, "elements": elements(joint, "driver_temperature" in signals)}
    body["kinds"] = {"one": {"driver": "mit", "settings": settings}}
    body["devices"] = {f"{joint}_drive": device}
    return body, [NodeSpec(f"{joint}_drive", "can0", 1, f"joint_position.{joint}", constants)]


class OneJoint:
    """A joint that carries a load [N m]."""

    def __init__(self, joint="elbow", position=0.0, load=0.0):
        self.time = 0.0
        self.joint = joint
        self.position = np.array([position])
        self.load = np.array([load])

    def step(self, duration):
        self.time += duration

    def measure(self):
        names = ("joint_velocity", "motor_temperature", "driver_temperature")
        values = {name: np.zeros(1) for name in names}
        return {"joint_position": self.position.copy(), "joint_effort": self.load.copy(), **values}

    truth = measure

    def drive(self, element, target, enabled):
        if enabled:
            self.position[0] = target

    def break_part(self, part):
        raise ValueError(part)

    def close(self):
        pass


def node(bench, joint):
    return bench.rig.node(f"{joint}_drive")


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
    assert node(bench, "elbow").wanted.stiffness == pytest.approx(40.0, abs=0.1)


def test_stiffness_grows_within_the_ramp(bench):
    bench.enable()
    grown = []
    for _ in range(25):
        grown.append(node(bench, "elbow").wanted.stiffness)
        bench.cycle()
    assert grown[0] < 10.0
    assert all(later >= earlier for earlier, later in itertools.pairwise(grown))
    assert grown[-1] == pytest.approx(40.0, abs=0.1)


def test_a_drive_that_remembers_a_command_is_not_moved_by_it():
    bench = mit_bench()
    bench.rig.step(0.0)
    old = mit.command(mit.Command(-2.0, 0.0, 300.0, 1.0, 0.0), MOTORS["AK80-9"].ranges)
    for data in (mit.special(Special.ENTER), old):
        bench.wires["can0"].send(can.Message(arbitration_id=2, data=data, is_extended_id=False))
    bench.rig.step(0.0)
    assert node(bench, "wrist").wanted.stiffness > 299  # the HAL died here, and now it starts again
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


def test_stiffness_is_that_of_the_joint_behind_its_gear(opened):
    settings = {**DAMIAO, "gear": 3.0, "direction": -1, "zero": 0.5, "stiffness": 400.0, "damping": 20.0}
    constants = MitConstants(gear=3.0, direction=-1, zero=0.5, load="joint_effort.elbow")
    world = OneJoint(load=6.0)
    bench = opened(*only("elbow", settings, constants), world)
    bench.enable()
    bench.follow([0.0], 200)
    assert world.position[0] == pytest.approx(6.0 / 400.0, rel=0.05)
    assert bench.sample.values["joint_effort"][0] == pytest.approx(-6.0, abs=0.3)


def test_most_effort_is_kept(opened):
    settings = {**DAMIAO, "max_effort": 1.5, "ramp": 0.0}
    body, nodes = only("elbow", settings, MitConstants())
    body["limits"] = {"joint_position": {"low": -3.0, "high": 3.0}}
    bench = opened(body, nodes, OneJoint())
    bench.enable()
    torques = []
    for _ in range(100):
        bench.follow([2.0])
        torques.append(abs(node(bench, "elbow").torque))
    # The spring pulls with 1.5 N m at most, against a damping of 2 and a friction of 0.1 N m s/rad; it is a little
    # less because the drive moves on until the next frame.
    assert 0.5 < bench.sample.values["joint_velocity"][0] < 1.5 / 2.1
    assert max(torques) < 1.55


def test_damps_on_its_way_to_off(opened):
    body, nodes = only("elbow", DAMIAO, MitConstants(load="joint_effort.elbow"), stop={"behaviour": "damp"})
    world = OneJoint(load=4.0)
    bench = opened(body, nodes, world)
    bench.enable()
    bench.cycle(10)
    bench.robot.stop("test")
    bench.cycle(60)
    assert bench.robot.mode == "stopping"
    assert node(bench, "elbow").wanted.stiffness == 0
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
    assert (node(bench, "elbow").wanted.stiffness, node(bench, "elbow").wanted.damping > 1.9) == (0, True)
    bench.cycle(40)
    assert not node(bench, "elbow").is_on
    assert bench.robot.mode == "fault"


@pytest.mark.parametrize("joint", ["elbow", "wrist"])
def test_a_fault_is_told_and_reset_without_enabling(bench, joint):
    bench.enable()
    bench.cycle(30)
    bench.rig.fault(f"emcy {joint}_drive")
    bench.until(lambda: bench.robot.mode == "fault", "fault", 5)
    assert "too hot" in bench.robot.fault_text
    bench.cycle(100)
    assert bench.device(f"{joint}_drive")["state"] == "fault"
    assert not any(node(bench, name).is_on for name in ("elbow", "wrist", "finger"))
    bench.robot.reset()
    bench.until(lambda: bench.states() == {"ready"}, "reset", 50)
    assert not node(bench, joint).is_on
    before = bench.world.position.copy()
    bench.enable()
    bench.cycle(40)
    assert bench.world.position == pytest.approx(before, abs=2e-3)


def test_a_fault_that_stays_is_told_again(bench):
    elbow = node(bench, "elbow")
    elbow.break_down()
    bench.cycle(2)
    bench.robot.reset()
    for _ in range(60):
        elbow.break_down()
        bench.cycle()
    assert bench.device("elbow_drive")["state"] == "fault"


@pytest.mark.parametrize("joint", ["elbow", "finger"])
def test_silent_and_back(bench, joint):
    bench.enable()
    bench.cycle(30)
    bench.rig.fault(f"node_silent {joint}_drive")
    bench.until(lambda: bench.robot.mode == "fault", "fault", 40)
    assert bench.device(f"{joint}_drive")["state"] == "silent"
    assert not bench.sample.valid["joint_position"].all()
    bench.cycle(80)
    bench.world.position[:] = [0.1, 0.1, 0.1]
    bench.rig.fault(f"node_back {joint}_drive")
    bench.until(lambda: bench.states() == {"ready"}, "back")
    bench.robot.reset()
    bench.enable()
    bench.cycle(40)
    assert bench.world.position == pytest.approx([0.1, 0.1, 0.1], abs=2e-3)


def test_a_drive_that_lost_its_power_for_a_moment_stops_the_robot(bench):
    bench.enable()
    bench.cycle(30)
    bench.rig.fault("node_reboot elbow_drive")
    bench.until(lambda: bench.robot.mode == "fault", "fault", 5)
    assert "by itself" in bench.robot.fault_text


def test_a_forgotten_watchdog_is_found_before_there_is_power(bench):
    bench.cycle(5)
    bench.rig.fault("node_reboot elbow_drive")
    bench.cycle(2)
    bench.robot.enable()
    bench.until(lambda: bench.robot.mode == "fault", "refusal", 20)
    assert "forgot its watchdog" in bench.robot.fault_text
    assert not node(bench, "elbow").is_on
    bench.until(lambda: bench.states() == {"ready"}, "commissioned again")
    bench.robot.reset()
    bench.enable()


def test_when_the_hal_dies_damiao_lets_go_and_t_motor_does_not(bench):
    bench.enable()
    bench.cycle(30)
    for _ in range(60):
        bench.rig.step(0.005)
    assert not node(bench, "elbow").is_on
    assert node(bench, "elbow").error == 0xD
    assert node(bench, "wrist").is_on  # why it needs `allow_no_watchdog`
    assert "no watchdog" in bench.device("wrist_drive")["text"]
    bench.until(lambda: bench.robot.mode == "fault", "fault", 60)


def test_closing_leaves_nothing_on():
    bench = mit_bench().open()
    bench.enable()
    bench.cycle(20)
    bench.close()
    for joint in ("elbow", "wrist", "finger"):
        assert not node(bench, joint).is_on
        assert node(bench, joint).wanted.stiffness == 0
    assert int.from_bytes(node(bench, "elbow").registers[9], "little") == 0


def test_frames_that_are_none_of_ours(bench):
    bench.cycle(2)
    unknown = bench.buses["can0"].counters["unknown"]
    for identifier, data in (
        (0x11, b"\x11\0\0"),
        (0x000, b"\x02\x7f"),
        (0x11, b"\x15" + bytes(7)),
        (0, b"\x09" + bytes(7)),
        (0, b""),
    ):
        bench.send("can0", identifier, data)
    bench.flush()
    assert bench.device("elbow_drive")["counters"]["malformed"] == 1
    assert bench.device("wrist_drive")["counters"]["malformed"] == 1
    assert bench.buses["can0"].counters["unknown"] == unknown + 3
    assert bench.buses["can0"].counters["broken_handlers"] == 0
    bench.cycle()
    assert bench.sample.values["joint_position"] == pytest.approx([0.4, -0.3, 1.2], abs=1e-3)


def test_a_position_beyond_the_range_is_never_believed(bench):
    bench.cycle(2)
    bench.world.position[1] = 12.4
    bench.cycle(2)
    bench.world.position[1] = 12.6  # firmware of T-Motor starts again at -12.5
    bench.cycle(2)
    assert not bench.sample.valid["joint_position"][1]
    assert "turned beyond" in bench.device("wrist_drive")["text"]
    bench.world.position[0] = 13.0  # that of Damiao stays at the end
    bench.cycle(2)
    assert not bench.sample.valid["joint_position"][0]
    bench.world.position[:] = 0.0
    bench.cycle(2)
    bench.robot.reset()
    bench.cycle(2)
    assert bench.states() == {"ready"}
    assert bench.sample.valid["joint_position"].all()


def test_turns_at_a_velocity(opened):
    settings = {**DAMIAO, "mode": "velocity"}
    body, nodes = only("elbow", settings, MitConstants())
    body["command"] = {"signal": "joint_velocity", "time_to_live": 0.1, "hold": 0.5}
    body["limits"] = {"joint_velocity": {"low": -5.0, "high": 5.0}}
    bench = opened(body, nodes, OneJoint())
    bench.enable()
    bench.follow([3.0], 60)
    # a friction of 0.1 against a damping of 2 N m s/rad
    assert bench.sample.values["joint_velocity"][0] == pytest.approx(3.0 * 2.0 / 2.1, abs=0.05)
    assert node(bench, "elbow").wanted.stiffness == 0


def test_pulls_with_an_effort(opened):
    body, nodes = only("elbow", {**T_MOTOR, "mode": "effort"}, hardware()[1].constants)
    body["command"] = {"signal": "joint_effort", "time_to_live": 0.1, "hold": 0.5}
    body["limits"] = {"joint_effort": {"low": -3.0, "high": 3.0}}
    body["stop"] = {"behaviour": "damp"}
    bench = opened(body, nodes, OneJoint())
    bench.enable()
    bench.follow([0.5], 20)
    assert bench.sample.values["joint_effort"][0] == pytest.approx(0.5, abs=0.02)
    assert (node(bench, "elbow").wanted.stiffness, node(bench, "elbow").wanted.damping) == (0, 0)


def test_identity_and_inspection(bench):
    devices = {device.name: device for device in bench.robot._devices}
    assert devices["elbow_drive"].identity == f"damiao:{node(bench, 'elbow').spec.serial:08x}"
    assert devices["wrist_drive"].identity == "mit:can0:2:AK80-9"
    found = {}
    bench.while_time_passes(lambda: found.update({name: device.inspect() for name, device in devices.items()}))
    assert all(check.is_good for check in found["elbow_drive"])
    assert {check.what for check in found["elbow_drive"]} >= {"watchdog", "control mode", "velocity range"}
    assert not {check.what: check for check in found["wrist_drive"]}["watchdog"].is_good


def test_another_motor_than_said_is_refused(opened):
    bench = opened(*only("elbow", DAMIAO, MitConstants(velocity=8.0)), OneJoint())
    told = bench.device("elbow_drive")
    assert told["state"] == "opening"
    assert "velocity range of 8" in told["text"]
    assert "ranges: {velocity: 8}" in told["text"]
