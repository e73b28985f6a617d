"""Estimates of elements from the rest of their own signal: better where it says more, and honest."""

import numpy as np
import pytest

from gemuco import BodySchema, TrainConfig, estimate, fit
from gemuco.anomaly.healthy import learn_normal
from gemuco.certainty.certainty import NINETY

UNITS = {"wheel": "m/s", "turn": "rad/s", "force": "N"}
MASKS = [("wheel", "turn"), ("wheel", "force"), ("turn", "force")]
NOISE = {"wheel": 0.02, "turn": 0.02, "force": 0.2}
Rows = dict[str, np.ndarray]


def drive(count: int, seed: int, track: float = 1.0) -> Rows:
    """Return noisy rows of a cart: its wheels know each other well, and its force knows their speed poorly."""
    draw = np.random.default_rng(seed)
    speed, turn = draw.uniform(0.0, 3.0, count), draw.uniform(-1.0, 1.0, count)
    signs = np.array([-1.0, 1.0, -1.0, 1.0])
    true = {
        "wheel": speed[:, None] + 0.5 * track * signs * turn[:, None],
        "turn": turn[:, None],
        "force": (speed**2)[:, None],
    }
    return {name: value + NOISE[name] * draw.standard_normal(value.shape) for name, value in true.items()}


def lost(rows: Rows, signal: str, *elements: int) -> Rows:
    """Return the same rows without some elements."""
    missing = {name: value.copy() for name, value in rows.items()}
    missing[signal][:, list(elements)] = np.nan
    return missing


@pytest.fixture(scope="module")
def cart() -> BodySchema:
    schema, _ = fit([drive(600, 0)], TrainConfig(epochs=60, seed=0), MASKS, units=UNITS)
    return schema


def test_a_wheel_is_known_from_the_other_wheels(cart: BodySchema) -> None:
    rows = drive(400, 1)
    wheel = estimate(cart, lost(rows, "wheel", 2))["wheel"]
    whole = estimate(cart, lost(rows, "wheel", 0, 1, 2, 3))["wheel"]
    assert (set(wheel.method), set(whole.method)) == ({"regression"}, {"mask"})
    assert wheel.mask[0] == frozenset(UNITS)
    error = wheel.value[:, 2] - rows["wheel"][:, 2]
    assert np.sqrt(np.mean(error**2)) < 1.25 * np.hypot(NOISE["wheel"], NOISE["wheel"])
    assert np.abs(error).mean() < 0.5 * np.abs(whole.value[:, 2] - rows["wheel"][:, 2]).mean()
    assert 0.85 < np.mean(np.abs(error) < NINETY * wheel.std[:, 2]) < 0.95
    assert (wheel.estimated == [False, False, True, False]).all()
    np.testing.assert_array_equal(wheel.value[:, [0, 1, 3]], rows["wheel"][:, [0, 1, 3]])


def test_values_that_were_never_seen_make_it_unknown_and_wide(cart: BodySchema) -> None:
    rows = drive(2, 2)
    inside = estimate(cart, lost(rows, "wheel", 2))["wheel"]
    rows["wheel"][1] += 30.0
    outside = estimate(cart, lost(rows, "wheel", 2))["wheel"]
    assert (inside.state == "known").all()
    assert outside.state.tolist() == ["known", "unknown"]
    assert "outside of the range of wheel" in outside.reason[1]
    assert outside.std[1, 2] > 5.0 * inside.std[1, 2]


def test_its_promise_holds_on_another_body_once_normal_errors_were_learned_from_it(cart: BodySchema) -> None:
    other = cart.with_normal(learn_normal(cart, cart.layout.join(drive(150, 3, track=1.3))))
    rows = drive(400, 4, track=1.3)
    wheel = estimate(other, lost(rows, "wheel", 0, 2))["wheel"]
    assert set(wheel.method) == {"regression"}
    within = np.abs(wheel.value - rows["wheel"])[:, [0, 2]] < NINETY * wheel.std[:, [0, 2]]
    assert 0.84 < within.mean() < 0.99


def test_without_normal_samples_there_is_none(cart: BodySchema) -> None:
    assert set(estimate(cart.with_normal(None), lost(drive(5, 5), "wheel", 2))["wheel"].method) == {"mask"}


def test_an_element_that_the_others_say_nothing_of_is_not_estimated_so() -> None:
    rows, held = drive(600, 6), drive(50, 7)
    for seed, part in enumerate((rows, held)):
        own = np.random.default_rng([6, seed]).normal(size=(len(part["turn"]), 2))
        part["turn"] = np.concatenate([part["turn"], own], axis=1)
    schema, _ = fit([rows], TrainConfig(epochs=20, seed=0), [("wheel", "force")], units=UNITS)
    turn = estimate(schema, lost(held, "turn", 2))["turn"]
    assert (np.abs(turn.value[:, 2] - held["turn"][:, 2]) < 4.0 * turn.std[:, 2]).mean() > 0.95
    assert np.median(turn.std[:, 2]) > 0.7


def test_a_search_from_parts_of_signals_has_the_errors_that_it_had_on_normal_samples(cart: BodySchema) -> None:
    truth = drive(60, 8)
    completed = estimate(cart, lost(lost(truth, "wheel", 0, 1, 2), "turn", 0))
    for name, element in (("wheel", 1), ("turn", 0)):
        within = np.abs(completed[name].value - truth[name]) < NINETY * completed[name].std
        assert within[:, element].mean() > 0.7
