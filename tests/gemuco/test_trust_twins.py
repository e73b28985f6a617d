"""Two encoders of one axis: where nothing else says which of them lies, both are named, and neither is used."""

from dataclasses import replace

import numpy as np
import pytest

from gemuco import Dataset, Episode, Layout, Signal, TrainConfig, fit
from gemuco.anomaly.healthy import learn_normal
from gemuco.schema import BodySchema
from gemuco.trust.config import BLOCK, Finding
from gemuco.trust.evidence import Evidence
from gemuco.trust.hypotheses import ALIKE, Signs, explain
from gemuco.trust.monitor import TrustMonitor
from gemuco.trust.relations import Relations

AXES, SAMPLES, NOISE, BEFORE, AFTER = 3, 5, 1e-3, 150, 60
NAMES = tuple(f"axis{number}" for number in range(AXES))
LAYOUT = Layout((Signal("motor_position", AXES, "rad", NAMES), Signal("joint_position", AXES, "rad", NAMES)))
SIZE, MOTOR, JOINT, OTHER = 2 * AXES, 0, AXES, 1
BOTH = frozenset({MOTOR, JOINT})


def walk(blocks: int, seed: int) -> np.ndarray:
    """Return smooth random motion as all encoders measure it [rad], shape (samples, SIZE)."""
    draw = np.random.default_rng(seed)
    time = np.arange(blocks * SAMPLES) * BLOCK / SAMPLES
    way = np.zeros((len(time), AXES))
    for axis in range(AXES):
        speed, phase = draw.uniform(0.3, 1.0, 4), draw.uniform(0.0, 2.0 * np.pi, 4)
        way[:, axis] = 0.3 * np.sin(time[:, None] * speed + phase).sum(axis=1)
    return np.hstack([way, way]) + draw.normal(0.0, NOISE, (len(time), SIZE))


@pytest.fixture(scope="module")
def model() -> BodySchema:
    """Return a model of three axes with two encoders each."""
    episodes = tuple(Episode("", LAYOUT.split(walk(150, 50 + seed))) for seed in range(6))
    config = TrainConfig(hidden=(20, 10), latent=AXES, bias_size=0, epochs=10, batch=100)
    schema = fit(Dataset(LAYOUT, episodes), config, (("motor_position",), ("joint_position",)))[0]
    return schema.with_normal(learn_normal(schema, np.concatenate([walk(200, 60 + seed) for seed in range(3)])))


def lied(model: BodySchema, values: np.ndarray) -> tuple[set[str], tuple[Finding, ...]]:
    """Judge samples; return the elements that are hidden at last, and all findings."""
    monitor = TrustMonitor(model)
    for number, block in enumerate(model.scaler.normalise(values).reshape(-1, SAMPLES, SIZE)):
        monitor.add(block, number * BLOCK)
    return {LAYOUT.element(position) for position in monitor.hidden}, monitor.findings


def test_only_the_encoders_of_one_axis_are_twins(model: BodySchema) -> None:
    relations = Relations.of(model)
    assert relations is not None
    for first in range(AXES):
        assert [second for second in range(AXES, SIZE) if relations.are_twins(first, second, frozenset())] == [
            first + AXES
        ]
    assert not relations.are_twins(MOTOR, OTHER, frozenset())
    assert not relations.are_twins(OTHER, OTHER + AXES, BOTH | {OTHER}), "a hidden one is no twin"


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("element", [MOTOR, JOINT])
def test_of_two_encoders_that_drift_apart_neither_is_used(model: BodySchema, element: int, seed: int) -> None:
    values = walk(BEFORE + AFTER, seed)
    values[BEFORE * SAMPLES :, element] += np.linspace(0.0, 0.06, AFTER * SAMPLES)
    hidden, findings = lied(model, values)
    assert hidden == {"motor_position.axis0", "joint_position.axis0"}
    assert [finding.cause for finding in findings] == ["either"]


@pytest.mark.parametrize("seed", range(3))
def test_an_encoder_that_moves_alone_is_no_more_suspect_than_its_twin_that_rests(model: BodySchema, seed: int) -> None:
    """The magnet of the joint's encoder came off, and this axis alone moves; or the motor's encoder drifts."""
    values, draw = walk(BEFORE + AFTER, seed), np.random.default_rng(seed)
    rest = values[BEFORE * SAMPLES :, OTHER:]
    rest[:] = values[BEFORE * SAMPLES - 1, OTHER:] + draw.normal(0.0, NOISE, rest.shape)
    hidden, findings = lied(model, values)
    assert hidden == {"motor_position.axis0", "joint_position.axis0"}
    assert [finding.cause for finding in findings] == ["either"]


@pytest.mark.parametrize("element", [MOTOR, JOINT])
def test_the_encoder_that_jumps_alone_is_the_wrong_one(model: BodySchema, element: int) -> None:
    values = walk(BEFORE + AFTER, 3)
    values[BEFORE * SAMPLES :, element] += 0.1
    assert lied(model, values)[0] == {LAYOUT.element(element)}


def evidence(*strength: float) -> Evidence:
    """Return evidence of these strengths; 20 is an alarm."""
    shares, zero = np.array([*strength, *np.zeros(4 - len(strength))]), np.zeros(4, bool)
    return Evidence(shares / 20.0, shares, np.full(4, 3), np.zeros(4), zero, zero, 1.0)


FIRST, SECOND = 0, 1


@pytest.mark.parametrize(
    ("left", "preferred", "cause"),
    [
        (0.1, {}, "either"),
        (1.2 * ALIKE, {}, "element"),
        (0.1, {"sudden": frozenset({SECOND})}, "element"),
        (0.1, {"held": frozenset({SECOND})}, "element"),
        (0.1, {"beyond": frozenset({SECOND})}, "either"),
        (0.1, {"alone": frozenset({SECOND})}, "either"),
    ],
)
@pytest.mark.parametrize("are_twins", [True, False])
def test_twins_are_told_apart_by_what_they_did_or_by_what_contradicts_one_without_the_other(
    left: float, preferred: dict[str, frozenset[int]], cause: str, are_twins: bool
) -> None:
    """The first is contradicted twice as much, which says nothing if each is known by the other alone."""
    whole, calm = evidence(60.0, 30.0), evidence(0.1)

    def without(columns: frozenset[int]) -> Evidence:
        return evidence(left) if columns == {SECOND} else replace(calm, ratio=0.1 * whole.ratio)

    def twins(first: int, second: int) -> bool:
        return are_twins and {first, second} == {FIRST, SECOND}

    result = explain(whole, without, (), (), frozenset(), Signs(**preferred), are_twins=twins)
    assert result.cause == (cause if are_twins else "element")
    if result.cause == "element":
        assert result.columns == {SECOND if preferred else FIRST}
    else:
        assert result.columns == {FIRST, SECOND}


def test_two_columns_are_no_pair_if_one_of_them_explains_the_alarm_and_nothing_contradicts_it() -> None:
    """A prediction that needs a right sensor is lost without it, and so is what contradicted the wrong ones."""
    whole, calm = evidence(60.0, 30.0, 2.0, 1.0), evidence(0.1)

    def without(columns: frozenset[int]) -> Evidence:
        return calm if columns & {2} or columns >= {FIRST, 3} else whole

    cause = explain(whole, without, (), (), frozenset())
    assert (cause.cause, cause.columns) == ("all", {FIRST, 3})
