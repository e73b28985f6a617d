"""Drives in MIT mode that break, fall silent, come back and forget, and frames that are none of theirs."""

import pytest
from hal_bench import ROBOTS
from mit_bench import DAMIAO, OneJoint, description, mit_bench, node, only

from hal.protocols import mit
from hal.protocols.mit import Special
from simulators.nodes.mit_drive import MitConstants


@pytest.fixture
def bench(open_mit):
    return open_mit()


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
    assert "lost its watchdog setting" in bench.robot.fault_text
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
        assert node(bench, joint).command.stiffness == 0
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


def test_another_master_is_counted(bench):
    bench.send("can0", 2, mit.special(Special.EXIT))
    bench.flush()
    assert bench.device("wrist_drive")["counters"]["foreign"] == 1
    assert bench.device("elbow_drive")["counters"]["foreign"] == 0


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


def test_another_motor_than_said_is_refused(open_mit):
    bench = open_mit(*only("elbow", DAMIAO, MitConstants(velocity=8.0)), OneJoint())
    report = bench.device("elbow_drive")
    assert report["state"] == "opening"
    assert "velocity range of 8" in report["text"]
    assert "ranges: {velocity: 8}" in report["text"]


def test_identifier_zero_is_not_shared_with_canopen():
    body = description()
    body["signals"]["joint_angle"] = {"unit": "rad", "elements": ["elbow"]}
    encoder = {"driver": "cia406", "settings": {"eds": "eds/joint_encoder.eds", "counts_per_turn": 4096}}
    body["kinds"]["encoder"] = encoder
    body["devices"]["encoder"] = {"kind": "encoder", "bus": "can0", "node": 9, "element": "joint_angle.elbow"}
    bench = mit_bench({**body, "folder": ROBOTS})
    bench.robot.open()
    assert "NMT" in bench.device("wrist_drive")["text"]
    assert not node(bench, "wrist").is_powered  # nothing was sent
    bench.robot.close()
