from itertools import pairwise

import numpy as np
import pytest
from muscle_arm import HIGH, LOW, gravity

from gemuco.controller import Controller
from gemuco.errors import NotFinite, NotObservable, SchemaError, UnknownSignal
from gemuco.search.descent import DescentConfig
from gemuco.search.losses import Match, StayNear, StaySmall
from gemuco.search.torque import TorqueBalance

GIVEN = frozenset({"joint_position", "muscle_tension"})
"""The target is given to the network as if it were measured, and the tensions descend."""
PAPER = (Match("joint_position"), StaySmall("muscle_tension"), TorqueBalance(gravity, weight=0.01))
HOLDING = (Match("joint_position"), StaySmall("muscle_tension", 0.05), TorqueBalance(gravity, weight=1.0))


def posture_of(arm, tension, length):
    """The posture [rad] whose lengths are these, by search: what the arm does when the tensions are held."""
    grid = np.stack(np.meshgrid(*(np.linspace(a - 0.3, b + 0.3, 161) for a, b in zip(LOW, HIGH, strict=True))), -1)
    grid = grid.reshape(-1, 2)
    return grid[np.argmin(((arm.length(grid, np.tile(tension, (len(grid), 1))) - length) ** 2).sum(axis=1))]


def test_reaches_a_reference(schema, arm):
    controller = Controller(schema, HOLDING, "muscle_length", "input", mask=GIVEN, search=DescentConfig(0.5, 10, 30))
    errors = []
    for theta in np.random.default_rng(7).uniform(LOW + 0.2, HIGH - 0.2, (8, 2)):
        solution = controller.solve({"joint_position": theta}, {})
        reached = posture_of(arm, solution.predicted["muscle_tension"], solution.command)
        errors.append(np.linalg.norm(reached - theta))
        assert solution.route == "input"
    assert np.mean(errors) < 0.06  # rad


def test_latent_route_predicts_the_reference(schema):
    controller = Controller(schema, (Match("joint_position"),), "muscle_length", "latent")
    for theta in np.random.default_rng(7).uniform(LOW + 0.2, HIGH - 0.2, (4, 2)):
        solution = controller.solve({"joint_position": theta}, {})
        assert solution.route == "latent"
        assert np.abs(solution.predicted["joint_position"] - theta).max() < 0.02  # rad
        assert np.isfinite(solution.residual)


def test_tensions_balance_gravity(schema, arm):
    theta = np.array([0.6, 1.0])
    solution = Controller(
        schema, HOLDING, "muscle_length", "input", mask=GIVEN, search=DescentConfig(0.5, 10, 60)
    ).solve({"joint_position": theta}, {})
    torque = -arm.jacobian(theta).T @ solution.predicted["muscle_tension"]
    assert solution.loss < 0.4
    assert np.linalg.norm(torque - gravity(theta)) < 1.0  # N m, of 2.1 N m
    assert (solution.predicted["muscle_tension"] >= 0.0).all()


def test_input_route_stays_on_the_manifold(schema):
    target = {"joint_position": np.array([0.4, 1.2])}
    solution = Controller(schema, PAPER, "muscle_length", "input", mask=GIVEN).solve(target, {})
    assert solution.residual < 0.3  # standard deviations
    np.testing.assert_allclose(solution.predicted["joint_position"], target["joint_position"])


def test_goes_on_from_where_it_was(schema):
    controller = Controller(schema, HOLDING, "muscle_length", "input", mask=GIVEN, search=DescentConfig(0.5, 10, 5))
    target = {"joint_position": np.array([0.4, 1.2])}
    losses = [controller.solve(target, {}).loss for _ in range(8)]
    assert all(after <= before + 1e-6 for before, after in pairwise(losses))
    assert losses[-1] < losses[0]


def test_a_term_on_the_command_is_pulled_back_through_the_network(schema, arm):
    theta = np.array([0.4, 1.2])
    near = arm.length(theta[None], np.full((1, 5), 60.0))[0]
    terms = (Match("joint_position"), StayNear("muscle_length", value=tuple(near)))
    solution = Controller(schema, terms, "muscle_length", "input", mask=GIVEN, search=DescentConfig(0.5, 10, 80)).solve(
        {"joint_position": theta}, {}
    )
    assert np.abs(solution.command - near).max() < 0.003  # m
    assert np.abs(solution.predicted["muscle_tension"] - 60.0).mean() < 20.0  # N


def test_says_what_is_wrong(schema):
    with pytest.raises(SchemaError, match="Known routes: auto, mask, latent, input"):
        Controller(schema, PAPER, "muscle_length", "magic")
    with pytest.raises(UnknownSignal, match="Known signals"):
        Controller(schema, PAPER, "wire")
    controller = Controller(schema, PAPER, "muscle_length")
    with pytest.raises(NotFinite, match="every element needs a number"):
        controller.solve({"joint_position": np.array([0.1, np.nan])}, {})
    with pytest.raises(NotObservable, match="a feasible mask of exactly muscle_length"):
        Controller(schema, None, "joint_position", "mask").solve({"muscle_length": np.full(5, 0.3)}, {})
