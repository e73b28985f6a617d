"""Parts of the body with several sensors: a muscle that is cut is not taken for lying sensors of others."""

from dataclasses import replace

import numpy as np
import pytest
from muscle_evidence import JOINT, LENGTH, MUSCLE, OTHER, SIZE, TENSION, evidence

from gemuco.trust.cases import Case
from gemuco.trust.evidence import Evidence
from gemuco.trust.hypotheses import Cause, Signs, explain, remaining


@pytest.mark.parametrize(
    ("rest", "length", "sudden", "cause", "columns"),
    [
        (0.3, 90.0, frozenset(), "part", MUSCLE),
        (0.55, 90.0, frozenset(), "element", {JOINT}),
        (0.3, 12.0, frozenset(), "element", {JOINT}),
        (0.3, 90.0, frozenset({JOINT}), "element", {JOINT}),
    ],
    ids=["it explains more, and less is left", "more is left", "it explains less", "the joint jumped"],
)
def test_a_part_has_changed_if_it_explains_an_alarm_better_than_a_joint(
    rest: float, length: float, sudden: frozenset[int], cause: str, columns: set[int]
) -> None:
    """Without the joint the alarm would be gone as well, and half as much is left as without any."""
    whole = evidence(joint=90.0, length=length, tension=20.0)

    def without(hidden: frozenset[int]) -> Evidence:
        share = rest if hidden >= MUSCLE else 0.5 if JOINT in hidden else 0.9
        return replace(whole, ratio=np.where(np.arange(SIZE) == OTHER, share, 0.0))

    result = explain(whole, without, (), (MUSCLE,), frozenset(), Signs(sudden))
    assert (result.cause, result.columns) == (cause, columns)


def test_its_sensor_alone_is_named_if_that_explains_the_alarm() -> None:
    whole = evidence(joint=60.0, tension=90.0, length=30.0)

    def without(hidden: frozenset[int]) -> Evidence:
        share = 0.2 if TENSION in hidden else 0.5 if JOINT in hidden else 0.9
        return replace(whole, ratio=np.where(np.arange(SIZE) == OTHER, share, 0.0))

    result = explain(whole, without, (), (MUSCLE,), frozenset())
    assert (result.cause, result.columns) == ("element", {TENSION})


@pytest.mark.parametrize(
    ("cause", "against", "stuck", "may_be_body"),
    [
        (Cause(frozenset({TENSION}), "element", TENSION), {"tension": 90.0, "length": 50.0, "joint": 10.0}, (), True),
        (Cause(frozenset({TENSION}), "element", TENSION), {"tension": 90.0, "length": 5.0, "joint": 10.0}, (), False),
        (Cause(frozenset({TENSION}), "element", TENSION), {"tension": 90.0, "length": 50.0}, (TENSION,), False),
        (Cause(frozenset({JOINT}), "element", JOINT), {"joint": 90.0, "length": 50.0}, (), False),
    ],
    ids=["both sensors are contradicted", "only one is", "it is stuck", "a joint has no part"],
)
def test_a_part_of_which_all_sensors_are_contradicted_leaves_the_body_unknown_for_others(
    cause: Cause, against: dict[str, float], stuck: tuple[int, ...], may_be_body: bool
) -> None:
    case = Case(cause, 1, 1, 1)
    case.weigh(evidence(**against), frozenset(), frozenset(stuck), [MUSCLE])
    assert case.may_be_body == may_be_body
    assert case.changes(frozenset({JOINT}), [MUSCLE]) == may_be_body
    assert not case.changes(frozenset({LENGTH}), [MUSCLE]), "its own sensors are judged as before"


@pytest.mark.parametrize(
    ("beyond", "is_plain", "may_be_body", "is_bound"),
    [
        ((), False, False, False),
        ((TENSION,), False, False, True),
        ((LENGTH,), False, False, True),
        ((OTHER,), False, False, False),
        ((), True, False, True),
        ((), False, True, True),
    ],
)
def test_a_part_that_changed_is_not_replaced_by_a_sensor_beside_it(
    beyond: tuple[int, ...], is_plain: bool, may_be_body: bool, is_bound: bool
) -> None:
    accused = Cause(frozenset({TENSION}), "element", TENSION)
    case = Case(accused, 1, 1, 1, is_plain=is_plain, may_be_body=may_be_body)
    joint, own = (Cause(frozenset({column}), "element", column) for column in (JOINT, LENGTH))
    assert case.is_bound(joint, [MUSCLE], frozenset(beyond)) == is_bound
    assert not case.is_bound(own, [MUSCLE], frozenset(beyond)), "it is of the same muscle"


def test_a_sensor_of_a_part_yields_to_a_joint_with_much_more_evidence_only() -> None:
    """The length has more evidence than the accused tension; both are of the muscle."""
    case, joint = Case(Cause(frozenset({TENSION}), "element", TENSION), 1, 1, 1), frozenset({JOINT})
    for strength, yields in ((70.0, False), (110.0, True)):
        whole = evidence(joint=strength, tension=20.0, length=50.0)
        assert case.yields_to(Cause(joint, "element", JOINT), whole, [MUSCLE], frozenset()) == yields
        own = Cause(frozenset({LENGTH}), "element", LENGTH)
        assert case.yields_to(own, whole, [MUSCLE], frozenset()), "2.5 times its evidence"
        assert not case.yields_to(case.cause, whole, [MUSCLE], frozenset())


def test_one_of_two_that_look_alike_needs_more_evidence_only() -> None:
    case = Case(Cause(frozenset({JOINT, OTHER}), "either", JOINT), 1, 1, 1)
    alone = Cause(frozenset({JOINT}), "element", JOINT)
    assert case.yields_to(alone, evidence(joint=10.0), [], frozenset())


@pytest.mark.parametrize(
    ("rest", "joint", "begun", "is_length"),
    [
        (0.7, 55.0, True, True),
        (0.7, 55.0, False, False),
        (0.9, 55.0, True, False),
        (0.7, 70.0, True, False),
    ],
    ids=["nearly as well", "nothing of it is hidden", "too much is left", "it explains much less"],
)
def test_the_other_sensor_of_a_part_that_has_begun_to_lie_needs_to_explain_it_nearly_as_well(
    rest: float, joint: float, begun: bool, is_length: bool
) -> None:
    whole, length = evidence(joint=joint, length=50.0), frozenset({LENGTH})

    def without(hidden: frozenset[int]) -> Evidence:
        share = 0.5 if JOINT in hidden else rest if LENGTH in hidden else 1.0
        return replace(whole, ratio=np.where(np.arange(SIZE) == OTHER, share, 0.0))

    result = explain(whole, without, (), (length,), frozenset(), Signs(begun=length if begun else frozenset()))
    assert result.columns == (length if is_length else {JOINT})


def test_a_part_may_leave_more_evidence_if_no_single_element_explains_an_alarm() -> None:
    whole = evidence(joint=90.0, length=80.0, tension=90.0)

    def without(hidden: frozenset[int]) -> Evidence:
        share = 0.8 if hidden == MUSCLE else 0.5 if hidden == {JOINT, TENSION} else 0.95
        return replace(whole, ratio=np.where(np.arange(SIZE) == OTHER, share, 0.0))

    assert explain(whole, without, (), (MUSCLE,), frozenset()).columns == MUSCLE, "a pair would leave less"


@pytest.mark.parametrize(
    ("hidden", "wrong", "parts", "begun"),
    [
        (set(), set(), [MUSCLE, {5, 6, 7}], set()),
        ({TENSION}, {TENSION}, [{LENGTH}, {5, 6, 7}], {LENGTH}),
        ({TENSION}, set(), [{5, 6, 7}], set()),
        ({5}, set(), [MUSCLE, {6, 7}], set()),
        ({TENSION, 5}, {5}, [{6, 7}], {6, 7}),
        (set(MUSCLE), set(MUSCLE), [{5, 6, 7}], set()),
    ],
    ids=[
        "all judged",
        "the tension lies",
        "the tension is missing",
        "one of three is",
        "one lies, one is missing",
        "both",
    ],
)
def test_a_sensor_that_is_missing_does_not_accuse_the_other_of_its_part(
    hidden: set[int], wrong: set[int], parts: list[set[int]], begun: set[int]
) -> None:
    every = [MUSCLE, frozenset({5, 6, 7})]
    assert remaining(every, frozenset(hidden), frozenset(wrong)) == (parts, begun)


def test_a_part_that_has_changed_leaves_the_body_unknown_also_if_a_joint_is_contradicted_more() -> None:
    case = Case(Cause(MUSCLE, "part", LENGTH), 1, 1, 1)
    case.weigh(evidence(joint=85.0, length=90.0, tension=20.0), frozenset(), frozenset(), [MUSCLE])
    assert case.changes(frozenset({JOINT}), [MUSCLE])
