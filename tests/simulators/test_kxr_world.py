"""What everybody who drives a World may rely on, and what the humanoid does under its tools."""

from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from simulators.bullet import BulletBody
from simulators.faults import UnknownPart
from simulators.robots.kxr_humanoid import forecast, simulator
from simulators.robots.kxr_humanoid.body import CELLS, REST, TOOLS, URDF, nominal
from simulators.robots.kxr_humanoid.feet import center_of, foot_forces
from simulators.robots.kxr_humanoid.statics import is_in_view, rest
from simulators.robots.kxr_humanoid.world import JOINTS

CONFIG = load_robot(Path(__file__).parents[2] / "robots" / "kxr_humanoid.yaml")
SIZES = {name: signal.size for name, signal in CONFIG.signals.items()}


@pytest.fixture(params=simulator.variants)
def world(request):
    world = simulator.world(request.param, 1)
    yield world
    world.close()


def drive(world, command, enabled: bool = True) -> None:
    for joint, angle in zip(JOINTS, command, strict=True):
        world.drive(f"joint_position.{joint}", float(angle), enabled)


def run(world, duration: float) -> None:
    for _ in range(round(duration / 0.02)):
        world.step(0.02)


def postures(count: int) -> np.ndarray:
    """Within limits and constraints with every tool."""
    random = np.random.default_rng(0)
    found = random.uniform(*CONFIG.bounds("joint_position"), (8 * count, 4))
    for tool in TOOLS.values():
        state = rest(nominal(), tool, found)
        stands = np.all(np.abs(state.center) < (0.035, 0.025), axis=1)
        found = found[stands & is_in_view(nominal().camera, state.pixel)]
    return found[:count]


def test_signals_have_the_robots_sizes_and_are_copies(world):
    for values in (world.measure(), world.truth()):
        assert {name: value.shape for name, value in values.items()} == {n: (s,) for n, s in SIZES.items()}
        before = {name: value.copy() for name, value in values.items()}
        drive(world, REST + 0.1)
        run(world, 0.1)
        for name in SIZES:
            np.testing.assert_array_equal(values[name], before[name])


def test_time_goes_by_what_was_asked(world):
    for duration in (0.005, 0.0013, 0.00002, 0.02):
        world.step(duration)
    assert world.time == pytest.approx(0.02632, abs=1e-12)


def test_the_same_seed_is_the_same_robot():
    def measured(seed: int) -> np.ndarray:
        world = simulator.world("actual", seed, "long_heavy")
        drive(world, REST + 0.1)
        run(world, 0.3)
        return np.concatenate(list(world.measure().values()))

    assert np.array_equal(measured(4), measured(4))
    assert not np.allclose(measured(4), measured(5))


def test_servos_follow_at_their_speed_and_hold_without_power(world):
    start = world.truth()["joint_position"]
    drive(world, start + 1.0)
    world.step(0.02)
    assert np.abs(world.truth()["joint_position"] - start).max() <= 7.48 * 0.02 + 1e-9
    run(world, 1.0)
    assert world.truth()["joint_position"] == pytest.approx(start + 1.0, abs=1e-4)
    drive(world, start, enabled=False)
    run(world, 0.5)
    assert world.truth()["joint_position"] == pytest.approx(start + 1.0, abs=1e-4)


def test_noise_is_the_actual_robots_alone():
    for variant, deviation in (("nominal", 0.0), ("actual", 0.002)):
        world = simulator.world(variant, 0)
        tips = [world.measure()["tool_tip_position"] - world.truth()["tool_tip_position"] for _ in range(200)]
        assert np.std(tips) == pytest.approx(deviation, rel=0.15)


def test_chain_and_pybullet_agree_on_the_urdf():
    chain = nominal().chain
    bullet = BulletBody(URDF, chain.joints, np.zeros(4))
    for joints in np.random.default_rng(0).uniform(-1.0, 1.0, (20, 4)):
        bullet.place(joints)
        assert bullet.inertia()[1] == pytest.approx(chain.gravity_torque(joints), abs=1e-6)
        rotations, origins = chain.frames(joints[None])
        turn, origin = bullet.frame("elbow_pitch")
        assert origin == pytest.approx(origins[-1, 0], abs=1e-6)
        assert turn == pytest.approx(rotations[-1, 0], abs=1e-6)
    bullet.close()


def test_joints_give_way_by_the_torque_of_the_commanded_posture():
    body, tool = nominal(), TOOLS["long_heavy"]
    command = np.array([[-1.2, 0.3, -0.4, -0.05]])
    state = rest(body, tool, command)
    energy = []
    for joint in range(4):
        for step in (1e-5, -1e-5):
            moved = command.copy()
            moved[0, joint] += step
            energy.append(_potential(moved, tool))
    torque = -(np.array(energy[::2]) - np.array(energy[1::2])) / 2e-5
    per_torque = np.radians([30.0, 30.0, 30.0, 15.0])
    assert state.joints[0] - command[0] == pytest.approx(per_torque * torque, rel=1e-4, abs=1e-7)


def _potential(command: np.ndarray, tool) -> float:
    body = nominal()
    rotations, origins = body.chain.frames(command[:, [3, 0, 1, 2]])
    held = body.grip + (tool.length - tool.center) * body.tool_direction
    height = tool.mass * (rotations[-1, 0] @ held + origins[-1, 0])[2]
    for link, mass in enumerate(body.chain.masses):
        height += mass * (rotations[link + 1, 0] @ body.chain.centers[link] + origins[link + 1, 0])[2]
    return 9.81 * height


def test_weight_moves_tip_and_center_of_gravity_as_far_as_in_the_paper():
    commands = postures(500)
    for length, tip, center in (("short", 0.048, 0.012), ("long", 0.072, 0.016)):
        light, heavy = (rest(nominal(), TOOLS[f"{length}_{weight}"], commands) for weight in ("light", "heavy"))
        assert np.linalg.norm(light.tip - heavy.tip, axis=1).mean() == pytest.approx(tip, abs=0.004)
        assert np.linalg.norm(light.center - heavy.center, axis=1).mean() == pytest.approx(center, abs=0.002)


def test_feet_carry_the_weight_where_it_is():
    for center in np.random.default_rng(0).uniform((-0.045, -0.05), (0.045, 0.05), (200, 2)):
        forces = foot_forces(center, 18.0)
        assert forces.min() >= 0.0
        assert forces.sum() == pytest.approx(18.0)
        assert center_of(forces) == pytest.approx(center, abs=1e-9)
    beyond = center_of(foot_forces(np.array([0.08, 0.0]), 18.0))
    assert 0.045 < beyond[0] <= CELLS[:, 0].max() + 1e-9


def test_a_tool_can_be_changed(world):
    light = world.truth()
    world.break_part("tool_changed:long_heavy")
    heavy = world.truth()
    assert heavy["foot_force"].sum() - light["foot_force"].sum() == pytest.approx(0.08 * 9.81, rel=0.1)
    assert np.linalg.norm(heavy["tool_tip_position"] - light["tool_tip_position"]) > 0.04


def test_what_the_camera_cannot_see_is_not_a_number(world):
    world.break_part("marker_removed")
    seen = world.measure()
    assert np.isnan(seen["tool_tip_position"]).all()
    assert np.isfinite(seen["tool_tip_pixel"]).all()
    world.break_part("camera_covered")
    assert np.isnan(world.measure()["tool_tip_pixel"]).all()
    world.break_part("camera_back")
    world.break_part("marker_back")
    assert np.isfinite(world.measure()["tool_tip_position"]).all()
    drive(world, [0.8, 0.0, 0.0, 0.0])
    run(world, 1.0)
    assert np.isnan(world.measure()["tool_tip_position"]).all()
    assert np.isnan(world.measure()["tool_tip_pixel"]).all()
    assert np.isfinite(world.truth()["tool_tip_position"]).all()


def test_the_cameras_own_process_sees_the_same():
    world, eye = simulator.world("nominal", 0), simulator.vision(CONFIG, "nominal", 0)
    truth = world.truth()
    assert np.array_equal(eye.see(truth)["tool_tip_pixel"], truth["tool_tip_pixel"])
    assert "marker" in eye.fault("marker_removed")
    assert np.isnan(eye.see(truth)["tool_tip_position"]).all()
    with pytest.raises(UnknownPart, match="camera_covered"):
        eye.fault("lens_broken")


def test_the_forecast_is_the_nominal_world():
    world = simulator.world("nominal", 0, "short_heavy")
    command = np.array([-0.8, 0.2, -1.1, -0.05])
    drive(world, command)
    run(world, 2.0)
    truth = world.truth()
    for name, report in forecast(CONFIG, "short_heavy", command[None]).items():
        assert report[0] == pytest.approx(truth[name], rel=1e-3, abs=1e-4)
    stiff = simulator.geometric("short_heavy", command[None])["tool_tip_position"][0]
    assert 0.02 < np.linalg.norm(stiff - truth["tool_tip_position"]) < 0.25


def test_wrong_names_and_numbers_are_told(world):
    with pytest.raises(UnknownPart, match=r"marker_removed.*tool_changed:long_heavy"):
        world.break_part("leg_broken")
    with pytest.raises(UnknownPart, match="tool_changed:short_light"):
        world.break_part("tool_changed:spoon")
    with pytest.raises(UnknownPart, match="short_light"):
        simulator.world("nominal", 0, "spoon")
    with pytest.raises(ValueError, match="nominal, actual"):
        simulator.world("ideal", 0)
    with pytest.raises(KeyError, match=r"joint_position\.ankle_pitch"):
        world.drive("joint_position.knee", 0.1, True)
    with pytest.raises(ValueError, match=r"ankle_pitch.* nan"):
        world.drive("joint_position.ankle_pitch", float("nan"), True)


def test_the_urdf_is_part_of_the_package():
    assert URDF.is_file()
    assert {"README.md", "LICENSE"} <= {path.name for path in URDF.parent.iterdir()}
