"""A servo drive in each of its modes, against the simulated one: what it is told, what it measures, how it starts."""

import itertools

import numpy as np
import pytest
from drive_bench import ELBOW, RATE, JointBench

from hal.errors import CommandRefused

COUNTS = 4096 * 50 / (2 * np.pi)
"""Per radian."""


@pytest.fixture
def joint():
    benches = []

    def made(*args, **how):
        benches.append(JointBench(*args, **how))
        return benches[-1].open()

    yield made
    for bench in benches:
        bench.close()


@pytest.mark.parametrize(("mode", "number"), [("profile_position", 1), ("ip", 7), ("csp", 8), ("csv", 9), ("cst", 10)])
def test_each_mode_is_set_and_mapped(joint, mode, number):
    bench = joint(mode)
    target = {1: 0x607A0020, 7: 0x60C10120, 8: 0x607A0020, 9: 0x60FF0020, 10: 0x60710010}[number]
    values = bench.objects
    assert values[0x6060, 0] == number
    assert [values[0x1600, sub] for sub in range(3)] == [2, 0x60400010, target]
    assert [values[0x1A00, sub] for sub in range(4)] == [3, 0x60410010, 0x60640020, 0x60770010]
    assert [values[0x1A01, sub] for sub in range(3)] == [2, 0x606C0020, 0x60F40020]
    assert [values[0x1A02, sub] for sub in range(2)] == [1, 0x22000110]
    assert (values[0x1802, 2], values[0x1803, 1] >> 31) == (20, 1)
    assert bench.cycle(3)[0].complete


def test_only_what_the_robot_file_names_is_mapped(joint):
    bench = joint("csv", quantities=("velocity",))
    assert [bench.objects[0x1A00, sub] for sub in range(3)] == [2, 0x60410010, 0x606C0020]
    assert bench.objects[0x1801, 1] >> 31
    assert bench.drive.measures == ("joint_velocity.elbow",)


def test_everything_is_measured_in_si_units(joint):
    bench = joint("csp")
    bench.world.load = 2.0
    bench.cycle(40)
    bench.enable()
    for cycle in range(20):
        bench.follow([0.3 + 0.005 * cycle])
    assert bench.value("position") == pytest.approx(bench.world.position, abs=0.01)
    assert bench.value("velocity") == pytest.approx(0.005 * RATE, rel=0.05)
    assert bench.value("effort") == pytest.approx(2.0, rel=0.01)
    assert bench.value("temperature") == pytest.approx(25.0, abs=0.5)
    assert abs(bench.value("following_error")) < 0.05
    assert bench.sample.valid["joint_temperature"].all()


@pytest.mark.parametrize("direction", [1, -1])
def test_direction_turns_position_velocity_and_effort_alike(joint, direction):
    bench = joint("csp", direction=direction, hardware={"direction": direction})
    bench.world.load = 3.0
    bench.cycle(2)
    assert bench.value("position") == pytest.approx(0.3, abs=1e-4)
    assert bench.value("effort") == pytest.approx(3.0, rel=0.01)
    assert bench.objects[0x6077, 0] * direction > 0


def test_a_wire_pulls_and_its_effort_is_negative(joint):
    hardware = {"spool_radius": 0.01, "zero": 0.0}
    bench = joint("csp", spool_radius=0.01, zero=0.0, hardware=hardware)
    bench.world.load = 40.0
    bench.cycle(2)
    assert bench.value("position") == pytest.approx(0.3, abs=1e-5)
    assert bench.value("effort") == pytest.approx(-40.0, rel=0.01)


@pytest.mark.parametrize(("code", "unit"), [(0x00B44700, None), (0xFDB44700, None), (0x00000000, "rpm")])
def test_velocity_units_are_read_from_the_drive_or_given(joint, code, unit):
    real = code or 0x00B44700
    bench = joint("csv", velocity_unit=unit, hardware={"velocity_unit": real})
    bench.enable()
    bench.follow([0.5], 60)
    assert bench.value("velocity") == pytest.approx(0.5, rel=0.05)
    motor_rpm = 0.5 * 50 * 60 / (2 * np.pi)
    assert bench.objects[0x60FF, 0] == pytest.approx(motor_rpm / (1e-3 if real >> 24 else 1.0), rel=0.01)


def test_velocity_starts_from_rest_whatever_was_asked_before(joint):
    bench = joint("csv")
    bench.enable()
    bench.follow([1.0], 40)
    assert bench.value("velocity") == pytest.approx(1.0, rel=0.05)
    bench.robot.disable()
    bench.cycle(60)
    still = bench.world.position
    assert bench.objects[0x60FF, 0] == 0
    bench.enable()
    bench.cycle(20)
    assert bench.world.position == pytest.approx(still, abs=1e-4)


@pytest.mark.parametrize(
    ("mode", "words"), [("csv", [0x07, 0x06]), ("profile_position", [0x07, 0x06]), ("csp", [0x06])]
)
def test_a_drive_that_may_be_moving_slows_down_before_it_is_let_go(joint, mode, words):
    bench = joint(mode)
    bench.enable()
    report = []
    bench.robot.disable()
    for _ in range(20):
        bench.cycle()
        report.append(bench.objects[0x6040, 0])
    assert list(dict.fromkeys(report)) == words
    assert bench.device("elbow")["state"] == "ready"


def test_a_drive_that_does_not_slow_down_is_let_go_all_the_same(joint):
    bench = joint("csv")
    bench.enable()
    bench.node._obey = lambda: None  # deaf to controlwords
    bench.robot.disable()
    report = []
    for _ in range(180):
        bench.cycle()
        report.append(bench.objects[0x6040, 0])
    assert list(dict.fromkeys(report)) == [0x07, 0x06]
    assert report.count(0x07) / RATE == pytest.approx(0.8, abs=0.02)


def test_torque_pushes_the_joint_and_ends_with_its_commands(joint):
    bench = joint("cst", limits={"low": -5, "high": 5})
    assert bench.objects[0x6072, 0] == 500  # 5 N m of 0.2 N m times 50, in thousandths
    bench.enable()
    bench.follow([1.0], 100)
    assert bench.objects[0x6071, 0] == 100
    assert bench.value("effort") == pytest.approx(1.0, rel=0.01)
    assert bench.value("velocity") == pytest.approx(2.0, rel=0.1)  # 1 N m against 0.5 N m s/rad
    bench.robot.disable()
    bench.cycle(60)
    assert bench.objects[0x6071, 0] == 0
    assert not bench.world.enabled


def test_torque_starts_from_none(joint):
    bench = joint("cst")
    bench.world.load = 4.0
    bench.cycle(5)
    assert bench.value("effort") == pytest.approx(4.0, rel=0.01)
    pushed = []
    bench.robot.enable()
    for _ in range(20):
        bench.cycle()
        pushed.append(bench.objects[0x6071, 0])
    assert set(pushed[:4]) == {0}


def test_damping_resists_motion(joint):
    bench = joint("cst", damping=0.8)
    assert bench.drive.can_damp
    bench.enable()
    bench.follow([2.0], 60)
    velocity = bench.value("velocity")
    bench.drive.damp()
    bench.turn()
    bench.rig.step(0.0)
    bench.cycle()
    assert velocity > 1.0
    assert JointBench("csp", quantities=("position",)).drive.can_damp is False


def test_profile_position_hands_every_set_point_over(joint):
    bench = joint("profile_position", profile={"velocity": 2.0, "acceleration": 20.0, "deceleration": 20.0})
    assert bench.objects[0x6081, 0] == pytest.approx(2.0 * COUNTS, abs=1)
    assert bench.objects[0x6083, 0] == bench.objects[0x6084, 0] == pytest.approx(20.0 * COUNTS, abs=1)
    bench.enable()
    bench.cycle(10)
    assert bench.world.position == pytest.approx(0.3, abs=1e-3)
    words = [bench.objects[0x6040, 0]]
    for _ in range(120):
        bench.follow([0.5])
        words.append(bench.objects[0x6040, 0])
    assert bench.world.position == pytest.approx(0.5, abs=1e-3)
    rises = sum(not before & 0x10 and bool(after & 0x10) for before, after in itertools.pairwise(words))
    assert rises == 1
    assert all(word & 0x20 for word in words if word & 0x10)


def test_profile_position_takes_the_newest_of_many(joint):
    bench = joint("profile_position", profile={"velocity": 4.0, "acceleration": 40.0, "deceleration": 40.0})
    bench.enable()
    for target in np.linspace(0.3, 0.6, 60):
        bench.follow([target])
    bench.follow([0.6], 100)
    assert bench.world.position == pytest.approx(0.6, abs=1e-3)
    assert bench.device("elbow")["text"] == ""


def test_a_drive_that_acknowledges_no_set_point_is_told(joint):
    bench = joint("profile_position")
    bench.enable()
    bench.node._mechanics.command = lambda *words: None
    for _ in range(300):
        bench.follow([0.5])
    assert "does not acknowledge set-points" in bench.device("elbow")["text"]


def test_interpolated_position_moves_while_the_drive_is_told_to_interpolate(joint):
    bench = joint("ip")
    bench.enable()
    for _ in range(40):
        bench.follow([0.35])
    assert bench.world.position == pytest.approx(0.35, abs=1e-3)
    assert bench.objects[0x6041, 0] & 1 << 12
    assert bench.objects[0x607A, 0] == 0
    node = bench.node
    node.objects.values[0x60C1, 1] = node.objects.values[0x60C1, 1] + 20_000
    node._controlword = 0x0F
    node.follow(node._now + 0.01)
    assert node._mechanics.target == pytest.approx(0.35, abs=1e-3)


@pytest.mark.parametrize("mode", ["profile_position", "ip", "csp", "csv", "cst"])
def test_quick_stop_brings_each_mode_to_rest_without_power(joint, mode):
    bench = joint(mode)
    bench.enable()
    for _ in range(40):
        bench.follow([{"csv": 2.0, "cst": 2.0}.get(mode, bench.value("position") + 0.05)])
    bench.drive.quick_stop()
    bench.turn()
    assert bench.objects[0x605A, 0] == 2
    bench.robot.disable()
    bench.cycle(80)
    still = bench.world.position
    assert bench.node.state.name == "SWITCH_ON_DISABLED"
    assert not bench.world.enabled
    bench.cycle(20)
    assert bench.world.position == still
    assert bench.device("elbow")["state"] == "ready"
    bench.enable()
    bench.cycle(20)
    assert bench.world.position == pytest.approx(still, abs=2e-3)


@pytest.mark.parametrize("mode", ["profile_position", "ip", "csp", "csv", "cst"])
def test_a_fault_is_left_by_an_edge_and_never_enables(joint, mode):
    bench = joint(mode)
    bench.enable()
    bench.rig.fault("emcy elbow")
    bench.cycle(40)
    assert bench.robot.mode == "fault"
    assert bench.device("elbow")["state"] == "fault"
    assert "(register: generic)" in bench.device("elbow")["text"]
    bench.cycle(100)
    assert bench.node.state.name == "FAULT"
    bench.robot.reset()
    bench.cycle(40)
    assert bench.device("elbow")["state"] == "ready"
    assert not bench.world.enabled
    bench.enable()


def test_the_drives_own_limits_are_written(joint):
    bench = joint("csp", limits={"low": -1.0, "high": 1.0}, max_velocity=3.0, following_error=0.1, max_torque=800)
    values = bench.objects
    assert values[0x607D, 1] == round((-1.2 + 0.2) * COUNTS)
    assert values[0x607D, 2] == round((1.2 + 0.2) * COUNTS)
    assert values[0x607F, 0] == pytest.approx(3.0 * COUNTS, abs=1)
    assert values[0x6080, 0] == pytest.approx(3.0 * 50 * 60 / (2 * np.pi), abs=1)
    assert values[0x6065, 0] == pytest.approx(0.1 * COUNTS, abs=1)
    assert values[0x6072, 0] == 800
    assert (values[0x6007, 0], values[0x1029, 1], values[0x1016, 1]) == (3, 0, 0x007F0096)


def test_limits_are_in_order_when_counts_grow_the_other_way(joint):
    low_high = {"low": -1.0, "high": 1.0}
    bench = joint("csp", limits=low_high, direction=-1, hardware={"direction": -1})
    low, high = bench.objects[0x607D, 1], bench.objects[0x607D, 2]
    assert (low, high) == (round(-1.4 * COUNTS), round(1.0 * COUNTS))


def test_velocity_limits_reach_the_drive(joint):
    bench = joint("csv", limits={"low": -2.0, "high": 1.0})
    assert bench.objects[0x607F, 0] == pytest.approx(2.2 * COUNTS, abs=1)


def test_too_large_a_following_error_is_the_drives_fault(joint):
    bench = joint("csp", following_error=0.05)
    bench.enable()
    bench.world.step = lambda duration: setattr(bench.world, "time", bench.world.time + duration)
    for _ in range(60):
        if bench.robot.mode == "fault":
            break
        bench.follow([0.8])
    assert "following error (8611h)" in bench.robot.fault_text


@pytest.mark.parametrize(
    ("method", "home"), [(17, -0.1), (18, 0.9), (37, 0.3), (33, None), (34, None), (1, None), (2, None)]
)
@pytest.mark.long
def test_homing_finds_the_zero(joint, method, home):
    settings = {"method": method, "speed": 2.0, "slow_speed": 0.3, "acceleration": 10.0}
    bench = joint("csp", homing=settings, zero=0.0, hardware={"switches": (-0.1, 0.9)})
    bench.cycle(3)
    bench.robot.home("elbow")
    bench.cycle(2)
    assert bench.device("elbow")["state"] == "homing"
    bench.until(lambda: bench.device("elbow")["state"] == "ready", "homing", 2000)
    bench.cycle(30)
    assert bench.device("elbow")["counters"]["homed"] == 1
    assert bench.objects[0x6060, 0] == 8
    assert not bench.world.enabled
    turn = 2 * np.pi / 50
    found = bench.world.position - bench.value("position")
    if home is None:
        assert (found + 0.2) / turn == pytest.approx(round((found + 0.2) / turn), abs=0.01)
    else:
        assert found == pytest.approx(home, abs=1e-3)
    bench.enable()
    bench.cycle(10)
    assert bench.value("position") == pytest.approx(bench.world.position - found, abs=1e-3)


def test_what_it_measures_begins_anew_after_homing(joint):
    """The position leaps to the new zero, which is no lie."""
    settings = {"method": 37, "speed": 1.0, "slow_speed": 0.1}
    bench = joint("csp", homing=settings, zero=-0.9)
    bench.cycle(5)
    before = bench.sample.values["joint_position"][0]
    bench.robot._assembler.plausibility._bounds.rate[:] = 8.0
    bench.robot.home("elbow")
    bench.until(lambda: bench.device("elbow")["counters"]["homed"], "homing", 400)
    bench.until(lambda: bench.robot.mode == "off", "off", 20)
    bench.cycle(3)
    assert abs(bench.sample.values["joint_position"][0] - before) > 0.4
    assert not bench.robot.health()["implausible"]
    bench.enable()


def test_homing_offset_moves_the_zero(joint):
    settings = {"method": 37, "speed": 1.0, "slow_speed": 0.1, "offset": 0.25}
    bench = joint("csp", homing=settings, zero=0.0)
    bench.cycle(3)
    bench.robot.home("elbow")
    bench.until(lambda: bench.device("elbow")["counters"]["homed"], "homing", 400)
    bench.cycle(30)
    assert bench.value("position") == pytest.approx(-0.25, abs=1e-3)


@pytest.mark.parametrize("stop", ["quick_stop", "disable"])
def test_homing_ends_when_it_is_stopped(joint, stop):
    settings = {"method": 17, "speed": 0.5, "slow_speed": 0.1}
    bench = joint("csp", homing=settings, hardware={"switches": (-3.0, 3.0)})
    bench.cycle(3)
    bench.robot.home("elbow")
    bench.until(lambda: bench.world.position < 0.25, "searching", 400)
    getattr(bench.drive, stop)()
    bench.cycle(100)
    assert not bench.world.enabled
    still = bench.world.position
    bench.cycle(50)
    assert bench.world.position == still
    assert "homing was stopped" in bench.device("elbow")["text"]
    assert bench.objects[0x6060, 0] == 8


def test_a_homing_error_is_told(joint):
    settings = {"method": 9, "speed": 0.5, "slow_speed": 0.1}
    bench = joint("csp", homing=settings)
    bench.cycle(3)
    bench.robot.home("elbow")
    bench.until(lambda: bench.device("elbow")["state"] == "ready", "homing", 400)
    assert "homing failed: the drive reports a homing error" in bench.device("elbow")["text"]


def test_homing_needs_settings_and_a_drive_that_is_ready(joint):
    bench = joint("csp", quantities=("position",))
    with pytest.raises(CommandRefused, match="no setting `homing`"):
        bench.drive.home()


def test_the_main_quantity_is_the_commanded_one():
    for mode, first in (("csp", "position"), ("csv", "velocity"), ("cst", "effort")):
        bench = JointBench(mode)
        assert next(iter(bench.drive.served)) == first
        assert bench.drive.commands == (ELBOW[first],)


MODES = ("profile_position", "ip", "csp", "csv", "cst")


def moving(bench):
    """Bring the joint into motion."""
    bench.enable()
    for cycle in range(40):
        wanted = 0.3 + 0.01 * cycle if bench.drive.command_quantity == "position" else 2.0
        bench.follow([wanted])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.long
def test_a_drive_whose_hal_died_stops_by_itself(joint, mode):
    bench = joint(mode)
    moving(bench)
    for _ in range(160):
        bench.rig.step(0.005)
    assert bench.node.state.name == "FAULT"
    assert not bench.world.enabled
    still = bench.world.position
    bench.clock.advance(0.8)
    bench.cycle(40)
    assert bench.robot.mode == "fault"
    assert bench.world.position == still
    bench.until(lambda: bench.device("elbow")["state"] == "fault", "commissioning again", 2000)
    bench.robot.reset()
    bench.until(lambda: bench.device("elbow")["state"] == "ready", "leaving the fault", 2000)
    bench.cycle(20)
    assert bench.world.position == still


@pytest.mark.parametrize("mode", MODES)
def test_a_drive_that_drops_out_by_itself_stays_off(joint, mode):
    bench = joint(mode)
    moving(bench)
    bench.node.state = bench.node.state.SWITCH_ON_DISABLED  # as safe torque off does
    bench.cycle(3)
    assert bench.robot.mode == "fault"
    bench.cycle(100)
    assert not bench.world.enabled
    assert bench.node.state.name != "OPERATION_ENABLED"


@pytest.mark.parametrize("mode", MODES)
def test_commands_of_before_a_fault_are_forgotten(joint, mode):
    bench = joint(mode)
    moving(bench)
    bench.robot.stop("test")
    bench.until(lambda: bench.robot.mode == "off", "stopping", 400)
    bench.cycle(20)
    still = bench.world.position
    bench.enable()
    bench.cycle(10)
    assert bench.world.position == pytest.approx(still, abs=1e-3)
