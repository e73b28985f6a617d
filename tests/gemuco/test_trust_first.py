"""What jumps first when an alarm begins is its cause; what may follow from a part that changed waits for motion."""

from dataclasses import replace

import numpy as np
import pytest
from muscle_evidence import JOINT, LENGTH, MUSCLE, OTHER, SIZE, TENSION, evidence
from test_trust_second import CHANGE, GRAVITY, SHOULDER, alarming, model, watched

from gemuco.trust.cases import SHOWN, Case
from gemuco.trust.config import BLOCK
from gemuco.trust.evidence import Evidence
from gemuco.trust.hypotheses import NONE, TOOL, Cause, Signs, explain

__all__ = ["model", "watched"]


@pytest.mark.parametrize(
    ("signs", "columns"),
    [
        (NONE, {JOINT}),
        (Signs(first=frozenset({TENSION})), {TENSION}),
        (Signs(first=frozenset({TENSION}), sudden=frozenset({JOINT})), {TENSION}),
        (Signs(first=frozenset({OTHER})), {JOINT}),
    ],
    ids=["none jumped", "the tension did first", "the joint did after it", "one that explains nothing did"],
)
def test_what_jumped_first_is_the_cause_although_the_arm_that_falls_contradicts_the_others_more(
    signs: Signs, columns: set[int]
) -> None:
    whole = evidence(joint=230.0, tension=100.0, length=30.0)

    def without(hidden: frozenset[int]) -> Evidence:
        share = 0.44 if JOINT in hidden else 0.5 if TENSION in hidden else 1.1
        return replace(whole, ratio=np.where(np.arange(SIZE) == OTHER, share, 0.0))

    result = explain(whole, without, (), (MUSCLE,), frozenset(), signs)
    assert (result.cause, result.columns) == ("element", columns)


@pytest.mark.parametrize(
    ("left", "part", "is_contested"), [(0.6, MUSCLE, True), (TOOL, MUSCLE, False), (0.6, frozenset({LENGTH}), False)]
)
def test_an_element_is_contested_if_a_muscle_would_explain_the_alarm_too(
    left: float, part: frozenset[int], is_contested: bool
) -> None:
    whole = evidence(joint=45.0, tension=7.0, length=18.0)

    def without(hidden: frozenset[int]) -> Evidence:
        share = 0.35 if JOINT in hidden else left if hidden >= part else 1.1
        return replace(whole, ratio=np.where(np.arange(SIZE) == OTHER, share, 0.0))

    result = explain(whole, without, (), (part,), frozenset())
    assert (result.columns, result.is_contested) == ({JOINT}, is_contested)


@pytest.mark.parametrize(
    ("is_contested", "motion", "is_hidden"),
    [(False, 0.0, True), (False, 1.0, True), (True, 0.0, False), (True, 1.0, True)],
)
def test_a_contested_element_is_not_hidden_at_rest(watched, is_contested, motion, is_hidden, monkeypatch):
    monitor, blocks = watched
    column = monitor._bench.place[GRAVITY]
    cause = Cause(frozenset({column}), "element", column, is_contested=is_contested)
    monkeypatch.setattr("gemuco.trust.monitor.explain", lambda *_: cause)
    monkeypatch.setattr(monitor, "_judge_again", lambda case: None)
    monkeypatch.setattr(monitor._bench.healthy, "motion", lambda moved: motion)
    alarming(monitor, column, 1.5)
    for number, block in enumerate(blocks, CHANGE):
        monitor.add(block, number * BLOCK)
        assert not is_contested or GRAVITY not in monitor.hidden or number - CHANGE >= SHOWN
    assert (GRAVITY in monitor.hidden) == is_hidden
    assert [finding.elements for finding in monitor.findings] == [(GRAVITY,)], "it is suspected at least"
    assert monitor._cases[0].moved >= motion * (len(blocks) - 1), "what is hidden moves on"


@pytest.mark.parametrize(("moved", "may_take"), [(SHOWN - 0.1, False), (SHOWN, True)])
def test_a_contested_element_takes_no_case_over_before_the_body_moved(watched, moved, may_take):
    monitor, _ = watched
    gravity, shoulder = (monitor._bench.place[element] for element in (GRAVITY, SHOULDER))
    case = Case(Cause(frozenset({gravity}), "element", gravity), 1, 1, 1, is_hidden=True, moved=moved)
    other = Cause(frozenset({shoulder}), "element", shoulder)
    assert monitor._may_take(other, case)
    assert monitor._may_take(replace(other, is_contested=True), case) == may_take


def test_what_jumped_first_is_remembered_while_the_alarm_lasts(watched, monkeypatch):
    monitor, blocks = watched
    bench, seen = monitor._bench, []
    jumped, other = (frozenset({bench.place[element]}) for element in (GRAVITY, SHOULDER))

    def explained(*facts: object) -> Cause:
        seen.append(next(fact for fact in facts if isinstance(fact, Signs)).first)
        return Cause(other if len(seen) == 2 else jumped, "either", min(jumped))

    monkeypatch.setattr("gemuco.trust.monitor.explain", explained)
    monkeypatch.setattr(monitor, "_replaces", lambda elements: False)
    monkeypatch.setattr(bench, "jumped", lambda age: jumped)
    for number, block in enumerate(blocks):
        monkeypatch.setattr(bench, "sudden", lambda age, number=number: jumped if number == 0 else frozenset())
        alarming(monitor, min(jumped), 0.0 if number == 4 else 1.5)
        monitor.add(block, (CHANGE + number) * BLOCK)
        if number == 3:
            assert set(seen) == {jumped}
            assert monitor._cases[0].cause.columns == jumped
            assert monitor._cases[0].is_plain, "it jumped alone, so it lies for certain"
            seen.clear()
    assert set(seen) == {frozenset()}, "another alarm began without a jump of one alone"
