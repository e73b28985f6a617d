"""A relation that is used in one direction only must not accuse the element that it predicts."""

import numpy as np
import pytest

from gemuco.trust.cases import FORGETS, LOOKS, Case, told_apart
from gemuco.trust.config import Hidden
from gemuco.trust.evidence import Evidence
from gemuco.trust.hypotheses import Cause, explain

SIZE, YAW, ACCELERATION = 4, 1, 2
PAIR = frozenset({YAW, ACCELERATION})


def evidence(strength: dict[int, float], healthy: dict[int, float] | None = None) -> Evidence:
    """Return evidence in which an alarm is at a strength of 50."""
    strengths, errors, no = np.full(SIZE, 0.1), np.ones(SIZE), np.zeros(SIZE, bool)
    for column, value in strength.items():
        strengths[column] = value
    for column, value in (healthy or {}).items():
        errors[column] = value
    return Evidence(np.sqrt(strengths / 50.0), strengths, np.full(SIZE, 5), np.zeros(SIZE), no, no, 1.0, errors)


def cause(without_yaw: float, without_acceleration: float, of_yaw: float = 1.0) -> Cause:
    """Explain a contradiction in the acceleration, which is predicted from the yaw rate.

    Args:
        without_yaw: What is left of the evidence without the yaw rate.
        without_acceleration: The same without the acceleration.
        of_yaw: How much worse the yaw rate is predicted without the acceleration; the reverse is four times.
    """
    left = {
        frozenset({YAW}): evidence({ACCELERATION: without_yaw}, {ACCELERATION: 4.0}),
        frozenset({ACCELERATION}): evidence({YAW: without_acceleration}, {YAW: of_yaw}),
    }
    whole = evidence({ACCELERATION: 80.0, YAW: 4.0})

    def without(columns: Hidden) -> Evidence:
        return left.get(columns, whole)

    return explain(whole, without, (), (), frozenset())


@pytest.mark.parametrize(
    ("without_yaw", "without_acceleration", "columns"),
    [(1.0, 12.0, {YAW}), (12.0, 1.0, {ACCELERATION}), (3.0, 5.0, PAIR), (40.0, 1.0, {ACCELERATION})],
)
def test_what_is_left_decides_where_a_relation_has_one_direction(without_yaw, without_acceleration, columns):
    result = cause(without_yaw, without_acceleration)
    assert result.columns == columns
    assert result.is_one_sided == (columns == PAIR)


def test_own_evidence_decides_where_both_predict_each_other():
    assert cause(1.0, 12.0, of_yaw=4.0).columns == {ACCELERATION}


def blocks(case: Case, count: int, yaw: float, acceleration: float, seed: int, look: float = 0.2) -> list[Case]:
    """Show a case blocks with these mean errors until it is told apart; return the changed cases."""
    draw = np.random.default_rng(seed)
    for _ in range(count):
        z = draw.normal([0.0, yaw, acceleration, 0.0], 0.5)
        if changed := told_apart([case], PAIR, z, np.full(SIZE, look)):
            return changed
    return []


def hidden() -> Case:
    return Case(Cause(PAIR, "either", ACCELERATION, is_one_sided=True), 0, 0, 0, is_hidden=True)


@pytest.mark.parametrize("seed", range(5))
def test_the_one_whose_errors_stay_large_lied(seed):
    case = hidden()
    assert blocks(case, 200, 2.5, 0.3, seed) == [case]
    assert (case.cause.columns, case.cause.cause) == ({YAW}, "element")
    assert case.looks.min() >= LOOKS


@pytest.mark.parametrize(("yaw", "acceleration"), [(0.3, 0.3), (2.5, 2.5), (1.5, 0.5), (2.5, 1.4)])
def test_both_stay_hidden_while_it_is_not_clear(yaw, acceleration):
    case = hidden()
    assert blocks(case, 400, yaw, acceleration, 0) == []
    assert case.cause.columns == PAIR
    assert case.looks.max() <= FORGETS


def test_few_looks_and_missing_values_say_nothing():
    assert blocks(hidden(), 10, 5.0, 0.0, 0) == []
    assert blocks(hidden(), 400, np.nan, 0.0, 0) == []
    assert told_apart([Case(Cause(PAIR, "either", YAW), 0, 0, 0)], PAIR, np.full(SIZE, 5.0), np.ones(SIZE)) == []
    assert told_apart([hidden()], frozenset({YAW}), np.full(SIZE, 5.0), np.full(SIZE, 99.0)) == []
