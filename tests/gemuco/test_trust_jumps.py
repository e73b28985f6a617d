"""Jumps of an element in its own values, and errors that were large before: which of two that contradict is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from gemuco.trust.changes import LONGEST
from gemuco.trust.config import BLOCK
from gemuco.trust.evidence import Evidence
from gemuco.trust.healthy import DOUBTED, PRIOR, Healthy
from gemuco.trust.hypotheses import Signs, explain
from gemuco.trust.jumps import EARLIER, KNOWN, Jumps
from gemuco.trust.recent import View

SAMPLES, SIZE = 5, 4
ERROR = np.full(SIZE, 0.1)
LEARNED = LONGEST + EARLIER + KNOWN
MOTOR, JOINT, LOAD, TIP = range(SIZE)


def motion(blocks: int, seed: int = 0) -> np.ndarray:
    """Return samples of smooth motion with a little noise, shape (blocks, SAMPLES, SIZE)."""
    random = np.random.default_rng(seed)
    phase = np.arange(blocks * SAMPLES)[:, None] * np.array([0.02, 0.02, 0.03, 0.05])
    return (np.sin(phase) + random.normal(0.0, 0.005, phase.shape)).reshape(blocks, SAMPLES, SIZE)


def after(samples: np.ndarray, hidden: frozenset[int] = frozenset()) -> Jumps:
    """Return the jumps after all blocks, learned as long as nothing is suspected."""
    jumps = Jumps()
    for number, block in enumerate(samples):
        jumps.add(block)
        if number < LEARNED + 10:
            jumps.learn(hidden)
    return jumps


def test_the_one_that_jumped_is_named_whenever_within_a_block_it_did() -> None:
    for sample in range(SAMPLES):
        samples = motion(LEARNED + 15)
        samples[LEARNED + 12, sample:, JOINT] += 0.5
        samples[LEARNED + 13 :, :, JOINT] += 0.5
        assert after(samples).sudden(3, ERROR) == {JOINT}
        assert not after(samples[: LEARNED + 12]).sudden(3, ERROR)


@pytest.mark.parametrize(
    ("usual", "pause", "named"),
    [
        (BLOCK, 1.3 * BLOCK, {JOINT}),
        (BLOCK, 2.0 * BLOCK, set()),
        (3.0 * BLOCK, 4.0 * BLOCK, {JOINT}),
        (0.1 * BLOCK, BLOCK, {JOINT}),
    ],
    ids=["a tick was late", "the machine stalled", "samples are rare", "the ticks before were late"],
)
def test_what_moved_while_samples_were_missing_has_not_jumped(usual: float, pause: float, named: set[int]) -> None:
    samples, jumps = motion(LEARNED + 15), Jumps()
    samples[LEARNED + 12 :, :, JOINT] += 0.5
    for number, block in enumerate(samples[: LEARNED + 14]):
        jumps.add(block, pause if number == LEARNED + 12 else usual)
        if number < LEARNED + 10:
            jumps.learn(frozenset())
    assert jumps.sudden(3, ERROR) == named


@pytest.mark.parametrize(
    ("wrong", "size", "named"),
    [
        ([JOINT], 0.08, set()),  # less than the error of a healthy prediction
        ([JOINT, MOTOR], 0.5, {JOINT, MOTOR}),  # exchanged, as it may be
        ([JOINT, MOTOR, TIP], 0.5, set()),  # a knock at the body
        ([JOINT, LOAD], [0.5, 0.12], {JOINT, LOAD}),
    ],
)  # fmt: skip
def test_a_jump_of_many_or_a_small_one_is_none_of_a_sensor(wrong: list[int], size: float, named: set[int]) -> None:
    samples = motion(LEARNED + 15)
    samples[LEARNED + 12 :, :, wrong] += size
    assert after(samples).sudden(3, ERROR) == named


def test_an_old_jump_is_not_named_and_a_usual_one_is_none() -> None:
    samples = motion(LEARNED + 30)
    samples[LEARNED + 12 :, :, JOINT] += 0.5
    jumps = after(samples)
    assert not jumps.sudden(10, ERROR)
    assert jumps.sudden(20, ERROR) == {JOINT}
    samples[20:, :, JOINT] += 0.5  # it did so before, and was right
    assert not after(samples).sudden(20, ERROR)


def test_the_first_blocks_name_nothing_because_no_jump_is_known_to_be_unusual() -> None:
    samples = motion(LEARNED - 2)
    samples[-6::2, :, JOINT] += 0.5
    assert not after(samples).sudden(3, ERROR)
    assert not after(samples).is_restless(frozenset({JOINT}), ERROR)


def test_a_missing_element_does_not_jump_when_it_returns() -> None:
    samples = motion(LEARNED + 15)
    samples[LEARNED : LEARNED + 12, :, JOINT] = np.nan
    samples[LEARNED + 12 :, :, JOINT] += 0.5
    assert not after(samples).sudden(3, ERROR)


def test_noise_is_restless_and_a_jump_there_and_back_is_not_for_long() -> None:
    noisy, once = motion(LEARNED + 40), motion(LEARNED + 40)
    noisy[LEARNED + 12 :, :, JOINT] += np.random.default_rng(1).normal(0.0, 0.5, (28, SAMPLES))
    once[LEARNED + 20 :, :, JOINT] += 0.5
    assert after(noisy).is_restless(frozenset({JOINT}), ERROR)
    assert not after(noisy).is_restless(frozenset({MOTOR}), ERROR)
    assert not after(once).is_restless(frozenset({JOINT}), ERROR)


def test_the_wrong_one_teaches_no_jumps_while_it_is_hidden() -> None:
    samples = motion(LEARNED + 15)
    samples[5:, :, JOINT] += np.random.default_rng(1).normal(0.0, 0.5, samples[5:, :, JOINT].shape)
    assert after(samples, frozenset({JOINT})).is_restless(frozenset({JOINT}), ERROR)
    assert not after(samples).is_restless(frozenset({JOINT}), ERROR)


def evidence(*accused: int) -> Evidence:
    """Return evidence against some columns, the strongest first."""
    strength, zero = np.zeros(SIZE), np.zeros(SIZE, bool)
    strength[list(accused)] = 60.0 - 20.0 * np.arange(len(accused))
    return Evidence(strength / 20.0, strength, np.full(SIZE, 3), np.zeros(SIZE), zero, zero, 1.0)


@pytest.mark.parametrize(
    ("sudden", "accused"), [((), JOINT), ((MOTOR,), MOTOR), ((JOINT,), JOINT), ((TIP,), JOINT), ((LOAD,), LOAD)]
)
def test_of_those_that_explain_an_alarm_the_one_that_jumped_is_wrong(sudden: tuple[int, ...], accused: int) -> None:
    """Two encoders of one axis contradict each other; the load, against which nothing speaks, would explain it too."""
    whole = evidence(JOINT, MOTOR)

    def without(columns: frozenset[int]) -> Evidence:
        return whole if columns <= {TIP} else replace(whole, ratio=0.1 * whole.ratio)

    cause = explain(whole, without, (), (), frozenset(), Signs(frozenset(sudden)))
    assert (cause.cause, cause.columns) == ("element", {accused})


def test_two_that_jumped_are_both_wrong_unless_a_part_of_the_body_or_another_tool_explains_it() -> None:
    whole, both, tool = evidence(JOINT, MOTOR, LOAD), frozenset({JOINT, MOTOR}), frozenset({LOAD})

    def without(columns: frozenset[int]) -> Evidence:
        return replace(whole, ratio=0.1 * whole.ratio)

    cause = explain(whole, without, (), (), frozenset(), Signs(both))
    assert (cause.cause, cause.columns, cause.is_exchange) == ("all", both, False)
    assert explain(whole, without, (), (both,), frozenset(), Signs(both)).columns == {JOINT}
    calm = replace(whole, ratio=0.01 * whole.ratio, level=0.5)
    other = explain(whole, without, (), (), tool, Signs(both), lambda: [("long", calm, True)])
    assert (other.cause, other.condition) == ("environment", "long")
    exchanged = explain(
        whole, without, (), (), frozenset(), Signs(both), exchanges=[(both, replace(calm, ratio=whole.ratio * 0.15))]
    )
    assert exchanged.is_exchange, "also if one of them alone explains it better"


@pytest.mark.parametrize(
    ("left", "signs", "cause"),
    [
        (0.7, Signs(frozenset({JOINT})), "element"),
        (0.7, Signs(alone=frozenset({JOINT})), "environment"),
        (0.7, Signs(), "environment"),
        (0.7, Signs(frozenset({MOTOR})), "environment"),
        (0.9, Signs(frozenset({JOINT})), "environment"),
    ],
)
def test_no_other_tool_is_believed_if_what_jumped_explains_as_much(left: float, signs: Signs, cause: str) -> None:
    """A gross lie of an encoder leaves more than a small one, and a p can be found that explains it at this posture."""
    whole, tool = evidence(JOINT, LOAD), frozenset({LOAD})

    def without(columns: frozenset[int]) -> Evidence:
        share = left if JOINT in columns else 0.7 if LOAD in columns else np.inf
        return replace(whole, ratio=np.minimum(whole.ratio, share))

    result = explain(whole, without, (), (), tool, signs)
    assert (result.cause, result.columns) == (cause, {JOINT} if cause == "element" else tool)


def test_errors_that_were_large_before_a_change_are_usual() -> None:
    random, none = np.random.default_rng(2), np.full(SIZE, np.nan)
    z = random.normal(0.0, 1.0, (LONGEST, SIZE))
    z[:, TIP] += 8.0
    z[-5:, JOINT] += 8.0
    z[:25, LOAD] = np.nan
    view = View(
        z,
        np.ones_like(z),
        np.zeros_like(z),
        np.zeros((1, SIZE)),
        np.zeros((1, SIZE)),
        frozenset(),
        none,
        np.zeros(SIZE),
        np.arange(LONGEST, dtype=float),
        20,
    )
    usual = view.usual(np.ones(SIZE), 8)
    assert usual[TIP] == pytest.approx(8.0 / 1.5, rel=0.1)
    assert usual[[MOTOR, JOINT, LOAD]] == pytest.approx(1.0), "as learned; or not known"
    scaled = view.scaled(usual)
    assert np.allclose(scaled.z * scaled.healthy, view.z * view.healthy, equal_nan=True)
    assert abs(scaled.z[:, TIP]).max() < 3.0
    assert view.usual(np.ones(SIZE), LONGEST) == pytest.approx(1.0), "nothing was seen before"


def test_large_errors_teach_little_once_the_body_is_known() -> None:
    def grown(blocks: int, step: float) -> float:
        healthy, noise = Healthy(1), np.zeros(1)
        for _ in range(blocks):
            healthy.add(np.ones((LONGEST, 1)), np.zeros(1), noise, 1.0)
        for _ in range(10):
            healthy.add(np.full((LONGEST, 1), 2.0), np.full(1, step), noise, 1.0)
        return float(healthy.scale[0]) ** 2 - 1.0

    assert grown(200, 5.0) == pytest.approx(DOUBTED * grown(200, 1.0), rel=0.2)
    early = int(PRIOR) - 20
    assert grown(early, 5.0) == pytest.approx(grown(early, 1.0)), "the first blocks are those of this body"
