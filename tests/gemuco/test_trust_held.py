"""An element that holds its value while all others move: of those that explain an alarm it is the likeliest."""

from dataclasses import replace

import numpy as np
import pytest

from gemuco.trust.evidence import Evidence
from gemuco.trust.hypotheses import Signs, explain
from gemuco.trust.jumps import HELD, LONGER_HELD, Repeats

SAMPLES, SIZE = 5, 5
FROZEN, RIGHT, OTHER, TOOL = 0, 1, 2, 4


def run(blocks: int, resting: list[tuple[int, int, list[int]]], pace: float = 1.0) -> list[frozenset[int]]:
    """Return the element that holds its value after each block of a motion.

    Args:
        blocks: Number of blocks.
        resting: First block, block after the last one, and the elements that keep their values meanwhile.
        pace: Motion in a block in which not all elements rest.
    """
    moves = np.ones((blocks, SIZE))
    for first, last, elements in resting:
        moves[first:last, elements] = 0.0
    values = np.cumsum(np.repeat(moves, SAMPLES, axis=0), axis=0).reshape(blocks, SAMPLES, SIZE)
    repeats, result = Repeats(), []
    for number, block in enumerate(values):
        repeats.add(block, pace * moves[number].any(), block.mean(axis=0), np.ones(SIZE))
        result.append(repeats.held)
    return result


def test_the_only_one_that_keeps_its_value_is_held_until_it_moves() -> None:
    held = run(60, [(30, 50, [FROZEN])], pace=0.25)
    first = 30 + round(HELD / 0.25)
    assert not any(held[: first - 1])
    assert all(elements == {FROZEN} for elements in held[first:50])
    assert not any(held[50:])


def test_none_is_held_while_the_body_rests_or_two_keep_their_values() -> None:
    assert not any(run(60, [(20, 40, list(range(SIZE)))]))
    assert not any(run(60, [(20, 40, [FROZEN, RIGHT])]))
    assert not any(run(60, [(20, 40, [FROZEN, RIGHT, OTHER])])), "more than half of them rest"


def test_a_rest_of_the_whole_body_before_does_not_count() -> None:
    held = run(60, [(10, 30, list(range(SIZE))), (30, 50, [FROZEN])])
    assert not any(held[:30])
    assert all(elements == {FROZEN} for elements in held[31:50])


def test_an_element_that_often_rests_alone_is_held_only_after_a_longer_time() -> None:
    held = run(100, [(10, 20, [FROZEN]), (40, 80, [FROZEN])])
    begins = next(number for number in range(40, 100) if held[number])
    assert begins == pytest.approx(40 + LONGER_HELD * 10, abs=2)


def test_one_that_rests_as_it_often_does_hides_no_other_one() -> None:
    held = run(100, [(10, 30, [OTHER]), (40, 55, [OTHER]), (42, 55, [FROZEN])])
    assert all(elements == {FROZEN} for elements in held[43:55])


def test_the_motion_of_one_joint_shows_nothing_of_the_others() -> None:
    """Some of them often rest while others move, so only this one rests for longer than usual."""
    often = [(10, 30, [RIGHT, OTHER]), (40, 60, [3])]
    assert any(run(100, [*often, (70, 80, [FROZEN, RIGHT])]))
    assert not any(run(100, [*often, (70, 80, [FROZEN, RIGHT, OTHER, 3])])[61:])


def evidence(*accused: int) -> Evidence:
    """Return evidence against some columns, the strongest first."""
    strength, zero = np.zeros(SIZE), np.zeros(SIZE, bool)
    strength[list(accused)] = 60.0 - 10.0 * np.arange(len(accused))
    return Evidence(strength / 20.0, strength, np.full(SIZE, 3), np.zeros(SIZE), zero, zero, 1.0)


@pytest.mark.parametrize("jumped", [(), (RIGHT,), (RIGHT, OTHER, 3)])
def test_of_those_that_explain_an_alarm_the_held_one_is_wrong(jumped: tuple[int, ...]) -> None:
    """So it is also if others seem to have jumped, as the tip does when a motion begins."""
    whole = evidence(RIGHT, OTHER, FROZEN, TOOL)

    def without(columns: frozenset[int]) -> Evidence:
        return replace(whole, ratio=0.1 * whole.ratio)

    cause = explain(
        whole, without, (), (), frozenset({TOOL}), Signs(jumped=frozenset(jumped), held=frozenset({FROZEN}))
    )
    assert (cause.cause, cause.columns) == ("element", {FROZEN})
    assert explain(whole, without, (), (), frozenset({TOOL}), Signs(jumped=frozenset(jumped))).columns != {FROZEN}


def test_a_held_one_that_does_not_explain_the_alarm_is_not_blamed() -> None:
    whole = evidence(RIGHT, FROZEN)

    def without(columns: frozenset[int]) -> Evidence:
        return replace(whole, ratio=(0.1 if RIGHT in columns else 1.0) * whole.ratio)

    assert explain(whole, without, (), (), frozenset(), Signs(held=frozenset({FROZEN}))).columns == {RIGHT}


def test_a_trained_tool_is_believed_if_it_explains_the_alarm_better_than_the_held_one() -> None:
    whole, tool = evidence(RIGHT, FROZEN), frozenset({TOOL})

    def without(columns: frozenset[int]) -> Evidence:
        return replace(whole, ratio=0.15 * whole.ratio)

    calm = replace(whole, ratio=0.01 * whole.ratio, level=0.5)
    cause = explain(whole, without, (), (), tool, Signs(held=frozenset({FROZEN})), lambda: [("long", calm, True)])
    assert (cause.cause, cause.condition) == ("environment", "long")
