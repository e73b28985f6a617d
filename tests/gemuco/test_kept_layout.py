"""What a controller and a simulator keep from solve to solve changes nothing: each solve is that of a fresh one."""

import numpy as np
import pytest
from muscle_arm import HIGH, LOW, gravity

from gemuco.controller import Controller
from gemuco.errors import NotFinite, NotObservable, WrongSize
from gemuco.schema import BodySchema
from gemuco.search.descent import DescentConfig
from gemuco.search.losses import Hold, Match, StayNear, StaySmall
from gemuco.search.torque import TorqueBalance
from gemuco.simulation import Simulator

LENGTH, TENSION, POSITION = "muscle_length", "muscle_tension", "joint_position"
GIVEN = frozenset({POSITION, TENSION})


class Own:
    """A term of the caller's own: the shoulder's reference is its weight, so it is another one each time."""

    signals = (TENSION,)

    def bind(self, schema, target, now):
        pull = float(target[POSITION][0])
        return StaySmall(TENSION, abs(pull)).bind(schema, target, now)


BALANCE, SMALL = TorqueBalance(gravity, 0.5), StaySmall(TENSION, 0.05)
CONTROL = {
    "as the arm is controlled": ((Match(POSITION), SMALL, BALANCE), "input", GIVEN),
    "on z": ((Match(POSITION), SMALL, BALANCE), "latent", None),
    "in SI": ((Match(POSITION, unit="si"), StaySmall(TENSION, 0.01, unit="si")), "latent", None),
    "near the present": ((Match(POSITION), StayNear(TENSION, 0.3)), "latent", None),
    "near the present, from inputs": ((Match(POSITION), StayNear(LENGTH, 0.3), SMALL), "input", GIVEN),
    "held in part": ((Match(LENGTH, 0.1), SMALL, Hold(POSITION)), "input", GIVEN),
    "held beside the mask": ((SMALL, Hold(POSITION)), "input", frozenset({TENSION, LENGTH})),
    "through a matrix": ((Match(POSITION, matrix=((1.0, 1.0),), value=(0.9,)), SMALL, Hold(POSITION)), "input", GIVEN),
    "by the rule": (None, "auto", None),
    "the caller's own": ((Match(POSITION), Own()), "latent", None),
}


def others(schema: BodySchema, random: np.random.Generator) -> BodySchema:
    """The same body with a W that is a little different."""
    arrays = [a * random.normal(1.0, 0.02, a.shape).astype(a.dtype) for a in schema.weights.arrays()]
    return schema.with_weights(schema.weights.replaced(arrays))


def part(random: np.random.Generator, values: np.ndarray, share: float = 0.3) -> np.ndarray:
    """Values, some of them missing, but never all."""
    gone = random.random(len(values)) < share
    gone[random.integers(len(values))] = False
    return np.where(gone, np.nan, values)


def asks(arm, random: np.random.Generator, terms) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """A target and a present."""
    theta, tension = random.uniform(LOW + 0.2, HIGH - 0.2), random.uniform(20.0, 80.0, 5)
    now = {TENSION: part(random, tension), LENGTH: part(random, arm.length(theta[None], tension[None])[0])}
    target = {POSITION: theta}
    if terms is None and random.random() < 0.5:
        target[TENSION] = tension
    if any(isinstance(term, Hold) for term in terms or ()):
        target[POSITION] = part(random, theta)
        if isinstance(terms[0], Match) and terms[0].signal == LENGTH:
            target[LENGTH] = arm.length(theta[None], tension[None])[0]
    return target, now if random.random() < 0.8 else {}


def outcome(solve, *arguments):
    """What a solve finds, or what it refuses."""
    try:
        found = solve(*arguments)
    except NotObservable as refusal:
        return str(refusal)
    predicted = np.concatenate([found.predicted[name] for name in sorted(found.predicted)])
    return np.concatenate([found.command, predicted, [found.loss, found.residual]]), found.route, found.mask


def same(one, other) -> None:
    assert type(one) is type(other)
    if isinstance(one, str):
        assert one == other
    else:
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1:] == other[1:]


@pytest.mark.parametrize("case", CONTROL)
@pytest.mark.parametrize("search", [None, DescentConfig(0.3, 6, 4)])
def test_a_kept_controller_is_a_fresh_one(schema, arm, case, search):
    terms, route, mask = CONTROL[case]
    random = np.random.default_rng(11)
    limits = {LENGTH: (np.full(5, 0.05), np.full(5, 0.6))}
    kept = Controller(schema, terms, LENGTH, route, search, mask, limits)
    solved = 0
    for index in range(25):
        if index % 8 == 7:
            kept.swap(others(schema, random))
        if random.random() < 0.3:
            kept.restart()
        fresh = Controller(kept.schema, terms, LENGTH, route, search, mask, limits)
        fresh._search._warm, fresh._search._last = kept._search._warm, kept._search._last
        target, now = asks(arm, random, terms)
        one, other = (outcome(controller.solve, target, now) for controller in (kept, fresh))
        same(one, other)
        solved += not isinstance(one, str)
    assert solved > 5


@pytest.mark.parametrize("route", ["latent", "input"])
def test_a_kept_simulator_is_a_fresh_one(schema, arm, route):
    mask = GIVEN if route == "input" else None
    choices = (
        (Match(LENGTH), SMALL, TorqueBalance(gravity, 0.3, at="predicted")),
        (Match(LENGTH), SMALL, Hold(POSITION)),
        (Match(LENGTH), SMALL, Match(POSITION, 0.1)),
    )
    random = np.random.default_rng(12)
    kept = Simulator(schema, choices[0], LENGTH, route, mask=mask)
    terms = choices[0]
    for index in range(24):
        if index % 6 == 5:
            terms = choices[int(random.integers(len(choices)))]
            kept.constrain(terms)
        fresh = Simulator(schema, terms, LENGTH, route, mask=mask)
        fresh._search._warm, fresh._search._last = kept._search._warm, kept._search._last
        theta, tension = random.uniform(LOW + 0.2, HIGH - 0.2), random.uniform(20.0, 80.0, 5)
        length = arm.length(theta[None], tension[None])[0]
        given = {} if terms is choices[0] else {POSITION: part(random, theta)}
        one, other = (simulator.step(length, given) for simulator in (kept, fresh))
        for name in other.values:
            np.testing.assert_array_equal(one.values[name], other.values[name])
        assert (one.loss, one.residual, one.mask) == (other.loss, other.residual, other.mask)


def test_a_solution_does_not_change_when_the_next_is_found(schema):
    """What is expected is computed when it is looked at, from what was asked then."""
    target = {POSITION: np.array([0.3, 0.9])}
    early, late = (Controller(schema, (Match(POSITION), SMALL), LENGTH, "latent") for _ in range(2))
    expected = outcome(early.solve, target)
    first = late.solve(target)
    target[POSITION][:] = [0.6, 0.4]
    late.solve(target)
    same(outcome(lambda: first), expected)


def test_a_solve_that_was_refused_leaves_nothing_behind(schema):
    terms = (Match(POSITION), SMALL, BALANCE)
    kept = Controller(schema, terms, LENGTH, "input", mask=GIVEN)
    kept.solve({POSITION: np.array([0.3, 0.9])})
    kept.restart()
    for wrong, error in ((np.array([0.3, np.nan]), NotFinite), (np.zeros(3), WrongSize)):
        with pytest.raises(error):
            kept.solve({POSITION: wrong})
    with pytest.raises(WrongSize, match="has 5 elements"):
        kept.solve({POSITION: np.array([0.5, 0.5])}, {TENSION: np.zeros(2)})
    target = {POSITION: np.array([0.6, 0.4])}
    fresh = Controller(schema, terms, LENGTH, "input", mask=GIVEN)
    same(outcome(kept.solve, target), outcome(fresh.solve, target))


def test_what_is_kept_is_bounded_and_goes_with_the_schema(schema):
    random = np.random.default_rng(13)
    kept = Controller(schema, (Match(POSITION), StayNear(TENSION, 0.3)), LENGTH, "latent")
    for _ in range(60):
        kept.solve({POSITION: np.array([0.3, 0.9])}, {TENSION: part(random, np.full(5, 40.0), 0.5)})
        assert len(kept._search._setups) <= 16
    kept.swap(others(schema, random))
    assert not kept._search._setups
