"""Recorded samples are inspected: who lied, from when to when, and what they should have read."""

import numpy as np
import pytest

from gemuco import BodySchema, Inspector, NotEnoughData, SchemaError, TrainConfig, WrongSize, fit, inspect

RATE, SECONDS = 10.0, 70.0
BEGIN, END = 20.0, 40.0
UNITS = {"joint": "rad", "cable": "mm", "tension": "N"}
Rows = dict[str, np.ndarray]


def motion(seed: int, seconds: float, rate: float = RATE) -> Rows:
    """Return samples of an arm with two joints and three elastic cables."""
    random, t = np.random.default_rng(seed), np.arange(0.0, seconds, 1.0 / rate)[:, None]
    joint = 0.3 * sum(np.sin(random.uniform(0.3, 2.0, 2) * t + random.uniform(0.0, 6.0, 2)) for _ in range(4))
    tension = 40.0 + 15.0 * np.sin(joint @ [[2.0, 1.0, 0.0], [0.0, -1.0, 2.0]])
    cable = 300.0 + joint @ [[40.0, -30.0, 0.0], [0.0, 25.0, -35.0]] + 0.1 * tension
    true = {"joint": joint, "cable": cable, "tension": tension}
    noise = {"joint": 0.003, "cable": 0.2, "tension": 0.2}
    return {name: value + random.normal(0.0, noise[name], value.shape) for name, value in true.items()}


@pytest.fixture(scope="module")
def schema() -> BodySchema:
    masks = [("joint", "tension"), ("cable", "tension"), ("joint", "cable"), ("joint",), ("cable",)]
    data = [motion(seed, 60.0, 20.0) for seed in range(4)]
    return fit(data, TrainConfig(seed=0, epochs=60), masks, units=UNITS)[0]


def span() -> slice:
    return slice(int(BEGIN * RATE), int(END * RATE))


def test_healthy_samples_hold_no_lie_and_stay_as_they_are(schema):
    rows = motion(11, SECONDS)
    result = inspect(schema, rows, RATE)
    assert result.lies == ()
    assert not any(part.any() for part in result.hidden.values())
    for name, values in rows.items():
        assert np.array_equal(result.values[name], values)
        assert not result.std[name].any()


@pytest.mark.parametrize("seed", [11, pytest.param(12, marks=pytest.mark.long)])
@pytest.mark.parametrize("size", [3.0, *(pytest.param(size, marks=pytest.mark.long) for size in (6.0, 20.0, 60.0))])
def test_an_offset_is_dated_named_and_repaired_however_large_it_is(schema, seed, size):
    rows = motion(seed, SECONDS)
    true = rows["cable"].copy()
    rows["cable"][span(), 1] += size
    result = inspect(schema, rows, RATE)
    lies = [lie for lie in result.lies if lie.is_hidden]
    assert [lie.elements for lie in lies] == [("cable.1",)]
    assert (lies[0].cause, lies[0].kind) == ("element", "offset")
    assert lies[0].start == pytest.approx(BEGIN, abs=0.2)
    assert lies[0].end == pytest.approx(END, abs=4.0)
    assert lies[0].size == pytest.approx(size, rel=0.2)
    assert result.hidden["cable"][span(), 1].all()
    assert result.hidden["cable"][:, [0, 2]].sum() == 0
    repaired = result.values["cable"][span(), 1][result.hidden["cable"][span(), 1]]
    error = repaired - true[span(), 1][result.hidden["cable"][span(), 1]]
    assert np.sqrt(np.mean(error**2)) < 1.0
    assert (result.std["cable"][:, 1] > 0.0).sum() == result.hidden["cable"][:, 1].sum()


def test_a_frozen_joint_is_found_and_what_is_usual_is_remembered(schema):
    inspector = Inspector(schema, RATE)
    assert not inspector.inspect(motion(13, SECONDS)).lies
    rows = motion(14, SECONDS)
    rows["joint"][int(BEGIN * RATE) :, 0] = rows["joint"][int(BEGIN * RATE), 0]
    lies = inspector.inspect(rows).lies
    assert [(lie.elements, lie.kind) for lie in lies if lie.is_hidden] == [(("joint.0",), "frozen")]
    assert lies[0].end == pytest.approx(SECONDS, abs=0.2)
    assert BEGIN - 0.2 <= lies[0].start < BEGIN + 2.0


@pytest.mark.long
def test_a_signal_that_was_not_measured_is_no_lie(schema):
    rows = motion(15, SECONDS)
    del rows["tension"]
    result = inspect(schema, rows, RATE)
    assert not result.lies
    assert np.isnan(result.values["tension"]).all()


def test_wrong_arguments_are_refused_in_a_sentence(schema):
    rows = motion(16, 5.0)
    with pytest.raises(SchemaError, match="rate is 0 Hz; it must be positive"):
        inspect(schema, rows, 0.0)
    with pytest.raises(WrongSize, match="One sample cannot be inspected"):
        inspect(schema, {name: value[0] for name, value in rows.items()}, RATE)
    with pytest.raises(NotEnoughData, match="What is normal for this model is not known"):
        inspect(schema.with_normal(None), rows, RATE)
