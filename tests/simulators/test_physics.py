"""Both engines of rigid bodies move, weigh and touch alike; a robot file chooses between them."""

from pathlib import Path

import numpy as np
import pytest
from test_urdf_arm import written

from hal.config import load_robot
from simulators.physics import choice
from simulators.physics.choice import engine, make_arm, make_body, using
from simulators.robots.musashi_arm import simulator as musashi
from simulators.robots.musashi_arm.body import REST, URDF
from simulators.robots.musashi_arm.motion import random_motion
from simulators.robots.pr2_duster import simulator as pr2
from simulators.robots.urdf_arm.body_file import physics_urdf
from simulators.robots.urdf_arm.choice import choose_arm
from simulators.robots.urdf_arm.survey import neutral
from simulators.robots.urdf_arm.tree import read_tree

ROBOTS = Path(__file__).parents[2] / "robots"
JOINTS = ("shoulder_roll", "shoulder_pitch", "shoulder_yaw", "elbow_pitch", "elbow_yaw")


@pytest.fixture
def both():
    pytest.importorskip("pybullet")
    pytest.importorskip("mujoco")


def made(name, make, *arguments):
    with using(name):
        return make(*arguments)


def test_the_engine_is_what_was_chosen_or_what_is_installed(monkeypatch):
    installed = {"pybullet", "mujoco"}
    monkeypatch.setattr(choice.importlib.util, "find_spec", lambda name: name if name in installed else None)
    assert engine() == "bullet"
    with using("mujoco"):
        assert engine() == "mujoco"
        with using(None):
            assert engine() == "bullet"
    installed.remove("pybullet")
    assert engine() == "mujoco"
    installed.clear()
    with pytest.raises(ModuleNotFoundError) as caught, using("mujoco"):
        engine()
    assert caught.value.name == "mujoco"
    with pytest.raises(ModuleNotFoundError) as caught:
        engine()
    assert caught.value.name == "pybullet"


def test_the_links_weigh_and_are_alike(both):
    bodies = [made(name, make_body, URDF, JOINTS, REST) for name in choice.MODULES]
    random = np.random.default_rng(0)
    for posture, speed in zip(random.uniform(-1.0, 1.0, (5, 5)), random.normal(0.0, 1.0, (5, 5)), strict=True):
        seen = []
        for body in bodies:
            body.place(posture)
            body.velocity[:] = speed
            seen.append((*body.inertia(), *body.frame("elbow_pitch")))
        for ours, theirs in zip(*seen, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_a_ball_in_the_hand_weighs_the_same(both):
    """In PyBullet the mass matrix is that of its first computation, so the ball comes before it."""
    bodies = [made(name, make_body, URDF, JOINTS, REST) for name in choice.MODULES]
    for body in bodies:
        body.add_mass("elbow_yaw", 0.5, 0.05)
    bare = made("mujoco", make_body, URDF, JOINTS, REST)
    heavy, heavy_too = (body.inertia() for body in bodies)
    np.testing.assert_allclose(heavy[0], heavy_too[0], atol=1e-5)
    np.testing.assert_allclose(heavy[1], heavy_too[1], atol=1e-4)
    assert np.abs(heavy[0] - bare.inertia()[0]).max() > 0.01


def test_a_pushed_arm_goes_the_same_way(both):
    """A quarter of a second under torques that change, before a joint is at its end."""
    ways = []
    for name in choice.MODULES:
        body = made(name, make_body, URDF, JOINTS, REST)
        way = []
        for number in range(250):
            _, hold = body.inertia()
            body.step(hold + 0.05 * np.sin(0.01 * number + np.arange(5)), 0.001)
            way.append(body.position.copy())
        ways.append(way)
        body.close()
    assert np.ptp(ways[0], axis=0).max() > 0.05
    np.testing.assert_allclose(*ways, atol=0.005)


@pytest.mark.parametrize("robot", ["musashi_arm", "pr2_duster"])
def test_the_worlds_of_shipped_robots_are_the_same_with_both(both, robot):
    config = load_robot(ROBOTS / f"{robot}.yaml")
    simulator = {"musashi_arm": musashi, "pr2_duster": pr2}[robot]
    command = config.command.signal
    names = [f"{command}.{element}" for element in config.signals[command].elements]
    ends = []
    for name in choice.MODULES:
        world = made(name, simulator.world, simulator.variants[0], 0)
        if robot == "musashi_arm":
            motion = random_motion(config, 0)
        else:
            goals = np.random.default_rng(0).uniform(*config.bounds(command), (3, len(names)))
            motion = ((goal, 0.5) for goal in goals)
        seen, elapsed = [], 0.0
        for values, duration in motion:
            for element, value in zip(names, values, strict=True):
                world.drive(element, value, True)
            world.step(duration)
            elapsed += duration
            seen.append(np.concatenate(list(world.truth().values())))
            if elapsed > 1.5:
                break
        ends.append(np.array(seen))
        world.close()
    scale = np.maximum(np.abs(ends[0]), 1.0)
    assert np.abs((ends[0] - ends[1]) / scale).max() < 0.02


def test_an_arm_of_a_urdf_carries_touches_and_follows_alike(both, tmp_path):
    arm = choose_arm(read_tree(written(tmp_path)))
    text, _ = physics_urdf(arm)
    bullet, mujoco = (made(name, make_arm, text, arm.names, neutral(arm), np.full(3, 200.0)) for name in choice.MODULES)
    random = np.random.default_rng(1)
    for posture in random.uniform(-1.0, 1.0, (10, 3)):
        for ours, theirs in zip(bullet.torques(posture), mujoco.torques(posture), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-4)
        assert bullet.touches(posture) == mujoco.touches(posture)
        apart = bullet.distance(posture, 0.2)
        assert apart == pytest.approx(mujoco.distance(posture, 0.2), abs=2e-3)
        assert (apart < 0.0) is bullet.touches(posture)
    for body in (bullet, mujoco):
        body.place(np.zeros(3))
    for number in range(400):
        goal = 0.3 * np.sin(0.01 * number) * np.ones(3)
        for body in (bullet, mujoco):
            body.step(goal)
        if number > 100:
            np.testing.assert_allclose(bullet.position, mujoco.position, atol=0.03)
            np.testing.assert_allclose(mujoco.position, goal, atol=0.1)
    for _ in range(400):
        for body in (bullet, mujoco):
            body.step(np.zeros(3))
    np.testing.assert_allclose(bullet.effort, mujoco.effort, atol=0.05)
    for body in (bullet, mujoco):
        body.close()


def test_the_robot_file_names_the_engine(both, tmp_path, monkeypatch):
    made_with = []
    monkeypatch.setattr(musashi, "world", lambda *arguments: made_with.append(engine()) or pytest.skip.Exception)
    monkeypatch.setattr("simulators.direct.direct_robot", lambda config, world: world)
    text = (ROBOTS / "musashi_arm.yaml").read_text()
    for name in (*choice.MODULES, "null"):
        file = tmp_path / "robot.yaml"
        file.write_text(f"{text}\nphysics: {name}\n")
        musashi.direct(load_robot(file), "geometric", 0)
    assert made_with == ["bullet", "mujoco", "bullet"]
