"""What everybody who drives a World may rely on, asked of the PR2's arm; its dusters; its camera."""

import math
from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from simulators.faults import UnknownPart
from simulators.robots.pr2_duster import forecast, simulator
from simulators.robots.pr2_duster.body import FASTEST, REST, URDF, chain, tool_tip
from simulators.robots.pr2_duster.camera import in_sight
from simulators.robots.pr2_duster.duster import CLOTH, FLEXIBLE, GRASPS, NORMAL, Foam, Grasp, sagged

CONFIG = load_robot(Path(__file__).parents[2] / "robots" / "pr2_duster.yaml")
SIZES = {"joint_position": 7, "tool_tip_position": 3}


@pytest.fixture(params=simulator.variants)
def world(request):
    world = simulator.world(request.param, 1)
    yield world
    world.close()


def run(world, duration: float) -> None:
    for _ in range(round(duration / 0.005)):
        world.step(0.005)


def drive(world, position: np.ndarray, enabled: bool = True) -> None:
    for joint, angle in zip(chain().joints, position.tolist(), strict=True):
        world.drive(f"joint_position.{joint}", angle, enabled)


def test_signals_have_the_robots_sizes_and_are_copies(world):
    for values in (world.measure(), world.truth()):
        assert {name: len(value) for name, value in values.items()} == SIZES
        before = {name: value.copy() for name, value in values.items()}
        drive(world, REST + 0.1)
        run(world, 0.05)
        assert all(np.array_equal(values[name], before[name]) for name in SIZES)


def test_time_goes_by_what_was_asked(world):
    for duration in (0.005, 0.0013, 0.00002, 0.02):
        world.step(duration)
    assert world.time == pytest.approx(0.02632, abs=1e-12)


def test_the_same_seed_is_the_same_arm():
    def history(seed: int) -> np.ndarray:
        world = simulator.world("actual", seed)
        world.break_part("tool_changed:long_phi30")
        measured = np.concatenate(list(world.measure().values()))
        world.close()
        return measured

    assert np.array_equal(history(4), history(4))
    assert not np.allclose(history(4), history(5))


def test_servos_follow_at_their_speed_and_hold_when_not_enabled(world):
    start = world.truth()["joint_position"]
    drive(world, start + 0.3, enabled=False)
    run(world, 0.2)
    assert world.truth()["joint_position"] == pytest.approx(start, abs=1e-9)
    drive(world, start + 0.3)
    run(world, 0.1)
    moved = world.truth()["joint_position"] - start
    assert np.all(moved <= 0.1 * FASTEST + 1e-9)
    run(world, 0.4)
    assert world.truth()["joint_position"] == pytest.approx(start + 0.3, abs=1e-4)


def test_joints_stay_between_their_stops(world):
    drive(world, np.full(7, 2.0))
    run(world, 3.0)
    assert np.all(world.truth()["joint_position"] <= chain().high + 0.05)
    assert world.truth()["joint_position"][[4, 6]] == pytest.approx([2.0, 2.0], abs=1e-3)


def test_pybullet_and_the_designers_model_agree():
    random = np.random.default_rng(0)
    low, high = CONFIG.bounds("joint_position")
    for condition in ("l300_phi0", "l700_phi60", "long_phi30"):
        world = simulator.world("nominal", 0, condition)
        position = random.uniform(low, high)
        drive(world, position)
        run(world, 2.0)
        truth = world.truth()
        world.close()
        report = forecast(CONFIG, condition, truth["joint_position"][None])["tool_tip_position"]
        assert truth["tool_tip_position"] == pytest.approx(report[0], abs=1e-5)


def test_noise_and_errors_are_the_actual_arms_alone():
    for variant, noise in (("nominal", 0.0), ("actual", 0.005)):
        world = simulator.world(variant, 0)
        difference = np.array(
            [world.measure()["tool_tip_position"] - world.truth()["tool_tip_position"] for _ in range(300)]
        )
        assert difference.std(axis=0) == pytest.approx(np.full(3, noise), rel=0.15)
        world.close()
    nominal, actual = (simulator.world(variant, 0, "l500_phi30").truth() for variant in simulator.variants)
    assert 0.002 < np.linalg.norm(nominal["tool_tip_position"] - actual["tool_tip_position"]) < 0.15


def test_the_stick_is_as_long_and_as_turned_as_the_condition_says():
    def stick(condition: str) -> np.ndarray:
        world = simulator.world("nominal", 0, condition)
        tip = world.truth()["tool_tip_position"] + [0.0, 0.0, CLOTH]
        world.close()
        return tip

    straight, far = stick("l300_phi0"), stick("l700_phi0")
    along = (far - straight) / 0.4
    assert np.linalg.norm(along) == pytest.approx(1.0)
    grip = straight - 0.3 * along
    turned = (stick("l500_phi60") - grip) / 0.5
    assert math.degrees(math.acos(along @ turned)) == pytest.approx(60.0)


def test_a_tool_changes_at_run_time(world):
    world.break_part("tool_changed:l700_phi0")
    before = world.truth()["tool_tip_position"]
    world.break_part("tool_changed:l300_phi0")
    assert np.linalg.norm(world.truth()["tool_tip_position"] - before) == pytest.approx(0.4, abs=0.08)


def test_the_foam_carries_what_hangs_on_it():
    foam = Foam(length=0.5, stiffness=0.7, moment=0.05)
    elevation = np.linspace(-1.5, 1.5, 13)
    along = np.column_stack([0.6 * np.cos(elevation), 0.8 * np.cos(elevation), np.sin(elevation)])
    behind = sagged(foam, along)
    assert np.linalg.norm(behind, axis=1) == pytest.approx(np.ones(13))
    angle = np.arcsin(behind[:, 2])
    assert foam.stiffness * (elevation - angle) == pytest.approx(foam.moment * 9.81 * np.cos(angle))
    assert behind[:, 0] / behind[:, 1] == pytest.approx(np.full(13, 0.75))


def test_stiff_foam_is_a_stiff_duster():
    flexible = Grasp(0.2, 0.5, Foam(length=0.5, stiffness=1e6, moment=0.05))
    at = REST[None]
    assert tool_tip(flexible, at) == pytest.approx(tool_tip(Grasp(0.7, 0.5), at), abs=1e-5)


def test_the_camera_can_be_covered_and_has_a_field_of_view():
    camera = simulator.vision(CONFIG, "actual", 0)
    truth = {"tool_tip_position": np.array([0.8, 0.1, 1.2])}
    assert camera.see(truth)["tool_tip_position"] == pytest.approx(truth["tool_tip_position"], abs=0.1)
    assert "covered" in camera.fault("camera_covered")
    assert np.isnan(camera.see(truth)["tool_tip_position"]).all()
    camera.fault("camera_back")
    assert np.isfinite(camera.see(truth)["tool_tip_position"]).all()
    with pytest.raises(UnknownPart, match="camera_covered"):
        camera.fault("lens_dirty")
    assert not in_sight(np.array([0.1, 0.0, 1.3]))
    assert not in_sight(np.array([0.0, 0.0, 3.0]))


def test_the_tool_is_mostly_in_sight():
    random = np.random.default_rng(0)
    low, high = CONFIG.bounds("joint_position")
    for condition in GRASPS:
        tips = forecast(CONFIG, condition, random.uniform(low, high, (300, 7)))["tool_tip_position"]
        assert np.mean([in_sight(tip) for tip in tips]) > 0.75


def test_wrong_names_and_numbers_are_told(world):
    with pytest.raises(UnknownPart, match="tool_changed:l300_phi0"):
        world.break_part("tool_changed:l300_phi1")
    with pytest.raises(KeyError, match=r"joint_position\.wrist_flex"):
        world.drive("joint_position.knee", 0.1, True)
    with pytest.raises(ValueError, match=r"joint_position\.wrist_flex.* nan"):
        world.drive("joint_position.wrist_flex", float("nan"), True)
    with pytest.raises(UnknownPart, match="l300_phi0"):
        simulator.world("nominal", 0, "l1_phi0")
    with pytest.raises(ValueError, match="nominal, actual"):
        simulator.world("real", 0)
    with pytest.raises(UnknownPart, match="l300_phi0"):
        forecast(CONFIG, "l1_phi0", REST[None])


def test_it_is_the_papers_conditions():
    assert CONFIG.conditions == NORMAL
    assert len(FLEXIBLE) == 6
    assert {GRASPS[name].length for name in NORMAL} == {0.3, 0.5, 0.7}


def test_the_urdf_is_part_of_the_package():
    assert URDF.is_file()
    assert {"README.md", "LICENSE"} <= {path.name for path in URDF.parent.iterdir()}
