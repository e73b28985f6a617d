"""The humanoid's experiments in pieces: inverse kinematics, trials on a small model, what counts as recognised."""

from pathlib import Path

import numpy as np
import pytest

from gemuco.dataset import Dataset, Episode
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from hal.config import load_robot
from services.model.living_model import layout_of
from services.model.model_config import collect_config, model_config
from studies.paper.kxr.actual import taught_postures
from studies.paper.kxr.robot import (
    CENTER,
    JOINTS,
    PIXEL,
    TIP,
    Standing,
    designed,
    inverse,
    random_targets,
    safe_postures,
    stiff,
)
from studies.paper.kxr.simulated import PAPER_WEIGHT, TOOLS, UPDATES, with_weight
from studies.paper.kxr.trials import (
    follow,
    follow_blindly,
    order,
    recognise,
    samples_until,
    smoothed,
    steps_until,
)

ROBOT = load_robot(Path(__file__).parents[2] / "robots" / "kxr_humanoid.yaml")


@pytest.fixture(scope="module")
def schema():
    """A model of few samples and few epochs; good to about 10 mm."""
    layout, random = layout_of(ROBOT), np.random.default_rng(0)
    episodes = []
    for tool in TOOLS:
        commands = safe_postures(ROBOT, tool, 150, random)
        forecast = designed(ROBOT, tool)(commands)
        episodes += [
            Episode(tool, {n: forecast[n][i : i + 15] for n in (JOINTS, CENTER, TIP, PIXEL)}) for i in range(0, 150, 15)
        ]
    config = TrainConfig(hidden=(40,), latent=8, bias_size=2, epochs=100, batch=50, rate=1e-2, patience=100)
    masks = [(JOINTS,), (JOINTS, CENTER), (JOINTS, CENTER, PIXEL), (JOINTS, CENTER, TIP)]
    return fit(Dataset(layout, tuple(episodes)), config, masks)[0]


def test_safe_postures_keep_the_constraints():
    bounds = {name: one.bounds(2, name) for name, one in collect_config(ROBOT).constraints.items()}
    commands = safe_postures(ROBOT, "long_heavy", 40, np.random.default_rng(1))
    forecast = designed(ROBOT, "long_heavy")(commands)
    assert commands.shape == (40, 4)
    for name, (low, high) in bounds.items():
        assert np.all((forecast[name] >= low) & (forecast[name] <= high))


def test_inverse_kinematics_reaches_what_its_own_model_says():
    targets = random_targets(ROBOT, "long_middle", 6, np.random.default_rng(2))
    for model in (designed(ROBOT, "long_middle"), stiff(ROBOT, "long_middle")):
        forecast = model(inverse(ROBOT, model, targets))
        assert np.linalg.norm(forecast[TIP] - targets, axis=1).mean() < 0.003


def test_a_stiff_model_misses_where_the_designers_reaches():
    targets = random_targets(ROBOT, "long_middle", 6, np.random.default_rng(2))
    missed = {}
    for name, model in (("designed", designed), ("stiff", stiff)):
        commands = inverse(ROBOT, model(ROBOT, "long_middle"), targets)
        missed[name] = follow_blindly(Standing(ROBOT, "nominal", 0, "long_middle"), targets, commands).tips.mean()
    assert missed["designed"] < 0.003
    assert missed["stiff"] > 0.05


def test_tools_are_recognised_and_targets_reached_with_a_small_model(schema):
    body = Standing(ROBOT, "nominal", 0, "long_heavy")
    random = np.random.default_rng(3)
    samples = [body.go(one) for one in safe_postures(ROBOT, "long_heavy", 8, random)]
    path = recognise(schema.under("short_light"), samples, (JOINTS, CENTER, TIP, PIXEL), UPDATES["ekf"])
    assert path.shape == (9, 2)
    assert samples_until(path, schema, "long_heavy") <= 3
    assert order(schema.biases, TOOLS) > 0.9
    control = model_config(ROBOT).control
    targets = random_targets(ROBOT, "long_heavy", 10, random)
    course = follow(ROBOT, body, schema.under("short_light"), control, targets, UPDATES["ekf"])
    blind = follow(ROBOT, body, schema.under("short_light"), control, targets)
    assert course.tips[3:].mean() < 0.02 < blind.tips[3:].mean()
    assert course.centers.shape == (10, 2)


def test_recognised_means_near_and_for_good(schema):
    start, right = schema.biases["short_middle"], schema.biases["long_middle"]
    share = np.array([0.0, 0.5, 0.9, 0.5, 0.9, 0.95, 1.0])[:, None]
    path = start + share * (right - start)
    assert samples_until(path, schema, "long_middle") == 4
    assert samples_until(path[:4], schema, "long_middle") == float("inf")


def test_averages_over_the_last_steps():
    errors = np.array([10.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert smoothed(errors) == pytest.approx([10.0, 5.0, 10 / 3, 2.5, 2.0, 0.0, 0.0])
    assert steps_until(errors, 3.0) == 3
    assert steps_until(errors, 20.0) == 0
    assert steps_until(errors[::-1], 1.0) == float("inf")


def test_taught_postures_are_sixty_within_the_limits():
    postures = taught_postures(ROBOT)
    low, high = ROBOT.bounds(JOINTS)
    assert postures.shape == (60, 4)
    assert len(np.unique(postures, axis=0)) == 60
    assert np.all((postures > low) & (postures < high))


def test_the_papers_weight_is_put_on_the_center_of_gravity_alone():
    control = model_config(ROBOT).control
    weights = {term.match: term.weight for term in with_weight(control, PAPER_WEIGHT).terms}
    assert weights == {TIP: None, CENTER: PAPER_WEIGHT}
