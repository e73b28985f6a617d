"""Simulation: what a muscle-driven arm does when its wires are commanded, pushed and held."""

import numpy as np
import pytest
from muscle_arm import HIGH, LOW, gravity

from gemuco.errors import NotFinite, NotObservable, SchemaError, UnknownSignal, WrongSize
from gemuco.search.losses import Hold, Match, StaySmall
from gemuco.search.torque import TorqueBalance
from gemuco.simulation import Simulator, simulate

LENGTH, TENSION, POSITION = "muscle_length", "muscle_tension", "joint_position"
MASK = frozenset({POSITION, TENSION})


def constraints(torque=gravity):
    """The paper's terms (eq. musashi-sim1), with weights for this arm."""
    return (Match(LENGTH), StaySmall(TENSION, 0.02), TorqueBalance(torque, 0.3, at="predicted"))


def resting(arm, count, seed=3, torque=gravity):
    """States in which the muscles hold the arm: postures, tensions, lengths."""
    random = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        theta = random.uniform(LOW + 0.2, HIGH - 0.2)
        arms = arm.jacobian(theta)
        tension = random.uniform(25.0, 60.0, 5)
        tension = tension - np.linalg.pinv(arms.T) @ (arms.T @ tension + torque(theta))
        if tension.min() > 4.0 and tension.max() < 96.0:
            found.append((theta, tension, arm.length(theta[None], tension[None])[0]))
    return found


@pytest.mark.parametrize(("route", "mask"), [("auto", None), ("input", MASK)])
def test_wires_bring_about_posture_and_tensions(schema, arm, route, mask):
    wrong, tense = [], []
    for theta, tension, length in resting(arm, 8):
        *_, state = Simulator(schema, constraints(), LENGTH, route, mask=mask).run([length] * 3)
        assert state.route == ("latent" if route == "auto" else "input")
        wrong.append(np.linalg.norm(state.values[POSITION] - theta))
        tense.append(np.abs(state.values[TENSION] - tension).mean())
        assert np.isfinite(state.residual)
    assert np.mean(wrong) < 0.15  # rad
    assert np.mean(tense) < 18.0  # N, of a spread of 28


def test_goes_on_from_the_state_before(schema, arm):
    (_, _, length), *_ = resting(arm, 1)
    simulator = Simulator(schema, constraints(), LENGTH)
    losses = [state.loss for state in simulator.run([length] * 6)]
    assert losses[-1] <= losses[0] + 1e-6
    simulator.restart()
    assert simulator.step(length).loss == pytest.approx(losses[0], rel=1e-4)


def test_an_external_torque_pushes_the_arm(schema, arm):
    (theta, _, length), *_ = resting(arm, 1)
    push = np.array([0.8, 0.0])  # N m on the shoulder, that the muscles then need not supply

    def pushed(posture):
        return gravity(posture) - push

    free = Simulator(schema, constraints(), LENGTH, "input", mask=MASK)
    still = [state.values[POSITION] for state in free.run([length] * 4)][-1]
    free.constrain(constraints(pushed))
    moved = [state.values[POSITION] for state in free.run([length] * 4)][-1]
    assert moved[0] - still[0] > 0.01  # rad
    assert np.linalg.norm(still - theta) < 0.25


@pytest.mark.parametrize(
    ("route", "mask", "by"),
    [("latent", None, 0.3), ("input", MASK, 0.3), ("input", frozenset({TENSION, LENGTH}), 0.1)],
)
def test_a_forced_posture_is_held(schema, arm, route, mask, by):
    (theta, _, length), *_ = resting(arm, 1)
    forced = {POSITION: np.array([theta[0] + by, np.nan])}
    terms = (Match(LENGTH), StaySmall(TENSION, 0.1), Hold(POSITION))
    simulator = Simulator(schema, terms, LENGTH, route, mask=mask)
    states = list(simulator.run([length] * 3, forced))
    assert [s.values[POSITION][0] for s in states] == pytest.approx([theta[0] + by] * 3, abs=1e-3)
    wish = (Match(LENGTH), StaySmall(TENSION, 0.1), Match(POSITION, 0.1, value=(theta[0] + by, np.nan)))
    loser = Simulator(schema, wish, LENGTH, "latent").step(length)
    assert abs(loser.values[POSITION][0] - theta[0] - by) > 1e-3


def test_what_cannot_be_held_is_said(schema, arm):
    (theta, _, length), *_ = resting(arm, 1)
    stiff = Simulator(schema, (Hold(POSITION),), LENGTH, "input", mask=frozenset({TENSION, LENGTH}))
    with pytest.raises(NotObservable, match=r"joint_position.shoulder' cannot be held at .* the nearest solution is"):
        stiff.step(length, {POSITION: theta + 3.0})


def test_without_constraints_a_feasible_mask_is_enough(schema, arm):
    """Eq. musashi-sim1 needs a search; a command that decides everything needs none."""
    theta, tension, length = resting(arm, 1)[0]
    held = Simulator(schema, (Hold(TENSION, tuple(tension)),), LENGTH).step(length)
    assert (held.route, held.mask) == ("mask", {TENSION, LENGTH})
    assert np.linalg.norm(held.values[POSITION] - theta) < 0.1
    states = simulate(schema, [length, length], command=LENGTH, terms=(Hold(TENSION),), given={TENSION: tension})
    assert [state.route for state in states] == ["mask", "mask"]
    np.testing.assert_array_equal(states[1].values[POSITION], held.values[POSITION])


def test_says_what_is_wrong(schema):
    simulator = Simulator(schema, constraints(), LENGTH)
    with pytest.raises(NotFinite, match="every element needs a number"):
        simulator.step(np.full(5, np.nan))
    with pytest.raises(WrongSize, match="has 5 elements"):
        simulator.step(np.zeros(3))
    with pytest.raises(UnknownSignal, match="Known signals"):
        simulator.step(np.full(5, 0.3), {"joint_torque": np.zeros(2)})
    with pytest.raises(NotObservable, match="is in no term"):
        Simulator(schema, (), LENGTH).step(np.full(5, 0.3), {POSITION: np.zeros(2)})
    with pytest.raises(UnknownSignal, match="Known signals"):
        Simulator(schema, (), "wire")
    with pytest.raises(UnknownSignal, match="Known signals"):
        Simulator(schema, (StaySmall("effort"),), LENGTH)
    with pytest.raises(SchemaError, match="Known routes"):
        Simulator(schema, (), LENGTH, "magic")
    with pytest.raises(NotObservable, match="needs a feasible mask within muscle_length"):
        Simulator(schema, (), LENGTH, "mask").step(np.full(5, 0.3))
    with pytest.raises(NotObservable, match="has no value"):
        Simulator(schema, (Hold(POSITION),), LENGTH).step(np.full(5, 0.3))
    with pytest.raises(NotFinite, match="no element of its value"):
        Simulator(schema, (Hold(POSITION),), LENGTH).step(np.full(5, 0.3), {POSITION: np.full(2, np.nan)})
    with pytest.raises(SchemaError, match="reference or predicted"):
        TorqueBalance(gravity, at="somewhere")
