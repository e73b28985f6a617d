"""Random safe motion: smooth, within the robot file's limits, and it gets where it wants to."""

import subprocess
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from hal.config import load_robot
from simulators.robots.musashi_arm import gravity_torque, random_motion, simulator
from simulators.robots.musashi_arm.model import (
    LEAST_TENSION,
    MOST_TENSION,
    ROUTES,
    balanced_tensions,
    chain,
    designed_paths,
    wire_lengths,
)
from simulators.robots.musashi_arm.motion import SETTLE

CONFIG = load_robot(Path(__file__).parents[2] / "robots" / "musashi_arm.yaml")


def test_commands_stay_within_the_limits_and_the_rate():
    steps = list(islice(random_motion(CONFIG, 0), 3000))
    lengths = np.array([length for length, _ in steps])
    durations = np.array([duration for _, duration in steps])
    low, high = CONFIG.bounds("muscle_length")
    assert np.all((lengths > low) & (lengths < high))
    speed = np.abs(np.diff(lengths, axis=0)) / durations[1:, None]
    assert speed.max() < 0.8 * CONFIG.limits["muscle_length"].rate
    assert durations.sum() > 60.0


def test_motion_and_gravity_need_no_physics_engine():
    code = (
        "import sys; from simulators.robots.musashi_arm import gravity_torque, random_motion; "
        "gravity_torque([0.1, 0.2, 0.3, -0.4, 0.5]); sys.exit('pybullet' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_seed_is_the_motion():
    def lengths(seed: int) -> np.ndarray:
        return np.array([length for length, _ in islice(random_motion(CONFIG, seed), 100)])

    assert np.array_equal(lengths(1), lengths(1))
    assert not np.allclose(lengths(1), lengths(2))


def test_tensions_balance_gravity_in_every_posture():
    random = np.random.default_rng(3)
    low, high = CONFIG.bounds("joint_position")
    left_over = []
    for position in random.uniform(low, high, (300, 5)):
        tension = balanced_tensions(position, random.uniform(LEAST_TENSION, 110.0, 10))
        assert np.all((tension >= LEAST_TENSION) & (tension <= MOST_TENSION))
        left_over.append(np.abs(designed_paths().solve(position)[1].T @ tension + gravity_torque(position)).max())
    assert np.mean(np.array(left_over) < 1e-6) > 0.97
    assert max(left_over) < 2.0


def settle(variant: str, seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lengths asked for, positions and tensions reached after each rest, and the highest tension on the way."""
    world = simulator.world(variant, seed)
    asked, positions, tensions, peak = [], [], [], np.zeros(10)
    motion = random_motion(CONFIG, seed)
    while len(asked) < count:
        lengths, duration = next(motion)
        for muscle, length in zip(ROUTES, lengths, strict=True):
            world.drive(f"muscle_length.{muscle}", length, True)
        for _ in range(round(duration / 0.01)):
            world.step(0.01)
            state = world.truth()
            peak = np.maximum(peak, state["muscle_tension"])
            assert np.all(
                (state["joint_position"] > chain().low - 0.03) & (state["joint_position"] < chain().high + 0.03)
            )
        if duration == SETTLE:
            asked.append(lengths)
            positions.append(state["joint_position"])
            tensions.append(state["muscle_tension"])
    world.close()
    return np.array(asked), np.array(positions), np.array(tensions), peak


def test_the_geometric_arm_goes_where_the_model_says():
    asked, positions, tensions, peak = settle("geometric", 0, 20)
    predicted = np.array([wire_lengths(*state) for state in zip(positions, tensions, strict=True)])
    assert predicted == pytest.approx(asked, abs=5e-4)
    assert peak.max() < CONFIG.limits["muscle_tension"].soft_high


@pytest.mark.parametrize("seed", range(5))
def test_actual_arms_stay_safe_under_the_models_commands(seed):
    _, positions, _, peak = settle("actual", seed, 6)
    assert np.isfinite(positions).all()
    assert peak.max() < CONFIG.limits["muscle_tension"].trip_high
