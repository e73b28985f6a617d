"""The arm's links against PyBullet, and whether ten wires can turn five joints either way everywhere."""

from itertools import combinations

import numpy as np
import pybullet
import pytest

from hal.config import load_robot
from simulators.robots.musashi_arm import force_torque, gravity_torque
from simulators.robots.musashi_arm.body import make_body
from simulators.robots.musashi_arm.model import HAND, RADIUS, ROUTES, URDF, chain

CONFIG = load_robot(URDF.parents[3] / "robots" / "musashi_arm.yaml")
FOURS = np.array(list(combinations(range(10), 4)))


@pytest.fixture
def loaded():
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    yield client, pybullet.loadURDF(str(URDF), useFixedBase=True, flags=flags, physicsClientId=client)
    pybullet.disconnect(client)


def postures(count: int, seed: int, margin: float = 0.0) -> np.ndarray:
    low, high = CONFIG.bounds("joint_position")
    return np.random.default_rng(seed).uniform(low - margin, high + margin, (count, 5))


def test_links_are_where_pybullet_has_them(loaded):
    client, body = loaded
    for position in postures(10, 0):
        for index, angle in enumerate(position):
            pybullet.resetJointState(body, index, angle, physicsClientId=client)
        states = pybullet.getLinkStates(body, range(5), computeForwardKinematics=1, physicsClientId=client)
        pose = chain().pose(position)
        assert pose.origins[1:] == pytest.approx(np.array([state[4] for state in states]), abs=1e-7)
        centers = pose.points(np.arange(1, 6), chain().centers)
        assert centers == pytest.approx(np.array([state[0] for state in states]), abs=1e-7)


def test_gravity_torque_is_pybullets_inverse_dynamics(loaded):
    client, body = loaded
    for position in postures(10, 1):
        still = [0.0] * 5
        torque = pybullet.calculateInverseDynamics(body, position.tolist(), still, still, physicsClientId=client)
        assert gravity_torque(position) == pytest.approx(torque, abs=1e-6)


def test_a_force_on_the_hand_turns_the_joints_as_virtual_work_says():
    force, step = np.array([5.0, -20.0, 30.0]), 1e-6
    position = postures(1, 2)[0]

    def hand(q):
        return chain().pose(q).points(np.array([RADIUS]), HAND[None])[0]

    turned = [(hand(position + step * e) - hand(position - step * e)) / (2 * step) @ force for e in np.eye(5)]
    assert force_torque(position, force) == pytest.approx(turned, abs=1e-5)


def test_the_robot_file_stays_inside_the_mechanical_stops():
    low, high = CONFIG.bounds("joint_position")
    assert np.all(chain().low < low)
    assert np.all(chain().high > high)
    assert chain().joints == CONFIG.signals["joint_position"].elements
    assert tuple(ROUTES) == CONFIG.signals["muscle_length"].elements == CONFIG.signals["muscle_tension"].elements


def closure(arms: np.ndarray) -> float:
    """Torque [N m] that tensions of 0 to 1 N reach in the worst direction of joint space; 0 without force closure.

    The torques form a zonotope; each of its facets is spanned by four wires.
    """
    spans = arms[FOURS]
    normals = np.stack([(-1) ** k * np.linalg.det(np.delete(spans, k, axis=2)) for k in range(5)], axis=1)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-12] / length[length > 1e-12, None]
    heights = np.concatenate([normals, -normals]) @ arms.T
    return float(np.maximum(heights, 0.0).sum(axis=1).min())


def test_every_direction_of_torque_is_reachable_on_the_designed_arm():
    """200 N give at least 2 N m in the worst direction of the worst posture."""
    paths = make_body("geometric", 0).paths
    margins = [closure(paths.solve(position)[1]) for position in postures(200, 2)]
    assert 200.0 * min(margins) > 2.0


@pytest.mark.parametrize("seed", range(5))
def test_every_direction_of_torque_is_reachable_on_actual_arms(seed):
    paths = make_body("actual", seed).paths
    margins = [closure(paths.solve(position)[1]) for position in postures(100, seed, margin=0.1)]
    assert 200.0 * min(margins) > 1.0


def test_moment_arms_have_the_size_of_a_bone():
    paths = make_body("geometric", 0).paths
    arms = np.abs([paths.solve(position)[1] for position in postures(200, 4)])
    assert arms.max() < 0.060
    assert np.all(arms.max(axis=(0, 2)) > 0.025)


def test_only_the_biceps_spans_shoulder_and_elbow():
    paths = make_body("geometric", 0).paths
    arms = np.abs([paths.solve(position)[1] for position in postures(20, 5)]).max(axis=0)
    spans_both = (arms[:, :3] > 1e-9).any(axis=1) & (arms[:, 3:] > 1e-9).any(axis=1)
    assert [name for name, both in zip(ROUTES, spans_both, strict=True) if both] == ["biceps"]


def test_an_unknown_variant_lists_the_known_ones():
    with pytest.raises(ValueError, match="geometric, actual"):
        make_body("ideal", 0)
