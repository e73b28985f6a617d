"""A wire that was cut: its muscle is the cause, and no right sensor beside it is hidden."""

from dataclasses import replace

import numpy as np
import pytest
from muscle_evidence import JOINT, LENGTH, MUSCLE, OTHER, SIZE, TENSION, evidence

from gemuco.trust.cases import Case
from gemuco.trust.evidence import Evidence
from gemuco.trust.hypotheses import Cause, Signs, explain

NEIGHBOUR = 10
NEXT = frozenset({5, NEIGHBOUR})


@pytest.mark.parametrize(
    ("left", "tension", "beyond", "columns"),
    [
        (0.78, 40.0, {TENSION}, {TENSION}),
        (0.78, 40.0, {OTHER}, {JOINT}),
        (0.90, 40.0, {TENSION}, {JOINT}),
        (0.78, 0.0, {TENSION}, {JOINT}),
    ],
    ids=["it is beyond", "another one is", "too much is left", "nothing contradicts it"],
)
def test_a_tension_beyond_what_was_learned_is_believed_to_be_the_cause_although_more_is_left(
    left: float, tension: float, beyond: set[int], columns: set[int]
) -> None:
    """Without the joint less is left: the others do not know the posture to which the arm fell."""
    whole = evidence(joint=90.0, tension=tension)

    def without(hidden: frozenset[int]) -> Evidence:
        share = 0.5 if JOINT in hidden else left if TENSION in hidden else 1.1
        return replace(whole, ratio=np.where(np.arange(SIZE) == OTHER, share, 0.0))

    assert explain(whole, without, (), (MUSCLE,), frozenset(), Signs(beyond=frozenset(beyond))).columns == columns


def test_a_tension_beyond_what_was_learned_gives_way_to_the_length_if_that_explains_the_alarm_better() -> None:
    whole = evidence(joint=50.0, tension=90.0, length=120.0)
    for share, columns in ((0.4, {LENGTH}), (0.9, {TENSION})):

        def without(hidden: frozenset[int], share: float = share) -> Evidence:
            rest = 0.7 if TENSION in hidden else share if LENGTH in hidden else 1.1
            return replace(whole, ratio=np.where(np.arange(SIZE) == OTHER, rest, 0.0))

        result = explain(whole, without, (), (MUSCLE,), frozenset(), Signs(beyond=frozenset({TENSION})))
        assert result.columns == columns


@pytest.mark.parametrize(
    ("tension", "left", "columns"),
    [(70.0, 0.8, {LENGTH}), (50.0, 0.8, {JOINT, LENGTH}), (70.0, 0.9, {JOINT, LENGTH})],
    ids=["both sensors of the muscle are contradicted", "one is", "too much is left"],
)
def test_one_sensor_of_a_muscle_is_likelier_than_two_of_different_parts(
    tension: float, left: float, columns: set[int]
) -> None:
    whole = evidence(joint=75.0, tension=tension, length=120.0)

    def without(hidden: frozenset[int]) -> Evidence:
        share = 0.3 if hidden >= {JOINT, LENGTH} else left if hidden == {LENGTH} else 1.1
        return replace(whole, ratio=np.where(np.arange(SIZE) == OTHER, share, 0.0))

    assert explain(whole, without, (), (MUSCLE,), frozenset()).columns == columns


@pytest.mark.parametrize(
    ("cause", "columns", "sure", "crosses"),
    [
        ("all", {JOINT, LENGTH}, set(), True),
        ("all", {LENGTH, NEIGHBOUR}, set(), True),
        ("all", {LENGTH, TENSION}, set(), False),
        ("all", {JOINT, OTHER}, set(), False),
        ("all", {JOINT, 1}, set(), False),
        ("all", {JOINT, LENGTH}, {LENGTH}, True),
        ("all", {JOINT, LENGTH}, {JOINT, LENGTH}, False),
        ("either", {JOINT, LENGTH}, set(), False),
        ("element", {LENGTH}, set(), False),
    ],
)
def test_sensors_of_different_parts_are_not_hidden_together_unless_all_are_sure_to_lie(
    cause: str, columns: set[int], sure: set[int], crosses: bool
) -> None:
    """Nothing is known of a body of which the joints are no parts, or if one device measures all that is wrong."""
    case = Case(Cause(frozenset(columns), cause, min(columns)), 1, 1, 1)
    assert case.crosses([MUSCLE, NEXT], [frozenset({JOINT, 1, 2})], frozenset(sure)) == crosses
    exchanged = replace(case, cause=Cause(frozenset({JOINT, LENGTH}), "all", JOINT, is_exchange=True))
    assert not exchanged.crosses([MUSCLE, NEXT], [], frozenset())


@pytest.mark.parametrize(
    ("beyond", "again", "is_bound"),
    [({TENSION}, JOINT, True), ({TENSION}, TENSION, False), ({JOINT}, TENSION, False), (set(), JOINT, False)],
)
def test_of_two_that_look_alike_the_one_beyond_what_was_learned_is_not_used_again(
    beyond: set[int], again: int, is_bound: bool
) -> None:
    case = Case(Cause(frozenset({TENSION, JOINT}), "either", TENSION), 1, 1, 1)
    assert case.is_bound(Cause(frozenset({again}), "element", again), [MUSCLE], frozenset(beyond)) == is_bound
