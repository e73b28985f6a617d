"""Values that repeat to the last bit; and errors that were no lie, because they ended by themselves."""

from dataclasses import replace

import numpy as np
import pytest

from gemuco.trust.cases import Case
from gemuco.trust.changes import LONGEST
from gemuco.trust.evidence import Evidence
from gemuco.trust.healthy import MOST_CAREFUL, Healthy
from gemuco.trust.hypotheses import Cause, explain
from gemuco.trust.jumps import CALM_BLOCKS, STUCK, Repeats

SAMPLES, KNOWN = 5, 200
NOISY, COARSE = 0, 1
ERROR = np.full(2, 0.05)
CHANCE = 1e-8


def motion(blocks: int, pace: float = 0.01) -> np.ndarray:
    """Return the true values of two elements that stop for two seconds now and then, shape (blocks, SAMPLES, 2)."""
    moves = np.repeat(np.arange(blocks) % 60 < 40, SAMPLES)
    phase = np.cumsum(moves)[:, None] * pace * np.array([1.0, 1.3])
    return np.sin(phase).reshape(blocks, SAMPLES, 2)


def measured(true: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return what a noisy sensor and one of coarse steps read."""
    values = true + np.random.default_rng(seed).normal(0.0, 0.004, true.shape)
    values[..., COARSE] = np.round(true[..., COARSE], 2)
    return values


def stuck_after(values: np.ndarray, true: np.ndarray, motions: np.ndarray | None = None) -> list[frozenset[int]]:
    """Return the elements that are stuck after each block."""
    repeats, result = Repeats(), []
    for number, block in enumerate(values):
        repeats.add(block, 1.0 if motions is None else float(motions[number]), true[number].mean(axis=0), ERROR)
        result.append(repeats.stuck)
    return result


def test_a_noisy_sensor_that_repeats_while_the_body_moves_is_stuck_until_it_changes() -> None:
    true = motion(KNOWN + 40)
    values = measured(true)
    begin, end = KNOWN + 2, KNOWN + 20
    values[begin:end, :, NOISY] = values[begin, 0, NOISY]
    stuck = stuck_after(values, true)
    first = next(number for number, elements in enumerate(stuck) if elements)
    assert stuck[first] == {NOISY}
    assert begin + STUCK <= first < begin + 2.5 * STUCK
    assert all(NOISY in elements for elements in stuck[first:end])
    assert not any(stuck[end:])


def test_a_coarse_sensor_repeats_as_usual() -> None:
    true = motion(2000, pace=0.003)
    assert not any(stuck_after(measured(true), true))


def test_nothing_is_stuck_at_rest_or_where_its_prediction_rests_too() -> None:
    true = motion(KNOWN + 40)
    values = measured(true)
    values[KNOWN + 2 :, :, NOISY] = values[KNOWN + 2, 0, NOISY]
    motions = np.where(np.arange(len(true)) < KNOWN, 1.0, 0.0)
    assert not any(stuck_after(values, true, motions))
    still = true.copy()
    still[KNOWN:, :, NOISY] = still[KNOWN, 0, NOISY]
    assert not any(stuck_after(values, still))


def test_a_sensor_whose_noise_is_not_known_yet_is_not_judged() -> None:
    true = motion(60)[:35]  # it moves until now, so no block was calm
    values = measured(true)
    values[20:, :, NOISY] = values[20, 0, NOISY]
    assert not any(stuck_after(values, 30.0 * true))
    assert CALM_BLOCKS > 20


def test_missing_values_repeat_nothing() -> None:
    true = motion(KNOWN + 40)
    values = measured(true)
    values[KNOWN + 2 :, :, NOISY] = np.nan
    assert not any(stuck_after(values, true))


def evidence(ratio: list[float]) -> Evidence:
    """Return evidence of these shares of an alarm."""
    shares, zero = np.array(ratio), np.zeros(len(ratio))
    return Evidence(shares, 50.0 * shares, zero + 5.0, 9.0 * shares, zero > 1.0, zero > 1.0, 1.0)


@pytest.mark.parametrize(("rest", "cause"), [(0.4, "element"), (0.7, "body")])
def test_an_element_is_no_cause_if_much_is_left_without_it(rest: float, cause: str) -> None:
    whole = evidence([1.2, 0.5, 0.4])
    left = replace(whole, ratio=np.array([0.0, rest, 0.3]))

    def without(columns: frozenset[int]) -> Evidence:
        return left if columns else whole

    assert explain(whole, without, (), (), frozenset()).cause == cause


def test_another_tool_is_believed_although_more_is_left() -> None:
    """The relations of p are less exact, and to doubt a tool is to accuse a sensor that is right."""
    whole = evidence([1.2, 0.5, 1.3])
    left = replace(whole, ratio=np.array([0.7, 0.3, 0.0]))
    assert explain(whole, lambda columns: left, (), (), frozenset({2})).cause == "environment"


def test_an_alarm_that_was_none_is_raised_later_again_and_a_plain_lie_teaches_nothing() -> None:
    healthy = Healthy(3)
    before = healthy.limit(CHANCE)
    healthy.excuse([1], np.array([0.0, 11.0, 11.0]), was_hidden=True)
    after = healthy.limit(CHANCE)
    assert after[1] > 1.2 * before[1]
    assert after[[0, 2]] == pytest.approx(before[[0, 2]])
    assert healthy.caution == 3.0
    for _ in range(5):
        healthy.excuse([1], np.array([0.0, 11.0, 0.0]), was_hidden=True)
    assert healthy.caution == MOST_CAREFUL
    other = Healthy(3)
    other.excuse([1], np.array([0.0, 11.0, 0.0]), was_hidden=False)
    assert other.caution == 0.0
    for block in range(36_000):  # its usual steps are a little too large once in six seconds
        steps = np.full(3, 3.4 if block % 60 == 0 else 1.0)
        healthy.add(np.zeros((LONGEST, 3)), steps, np.zeros(3), 1.0)
        healthy.add_steps(steps)
    assert healthy.caution < 0.4 * MOST_CAREFUL
    assert healthy.limit(CHANCE)[1] < 1.1 * before[1]


def test_a_case_weighs_its_evidence_and_knows_a_plain_lie() -> None:
    case = Case(Cause(frozenset({1}), "element", 1), 0, 0, 0)
    none: frozenset[int] = frozenset()
    case.weigh(evidence([0.2, 1.1, 0.1]), none, none, [])
    case.weigh(evidence([0.2, 2.0, 0.1]), none, none, [])
    assert case.weight == pytest.approx(1.1**2 + 2.0**2)
    assert case.steps == pytest.approx([1.8, 18.0, 0.9])
    assert not case.is_plain
    case.weigh(evidence([0.2, 1.1, 0.1]), none, frozenset({0, 1}), [])
    assert case.is_plain
    assert not case.has_jumped
