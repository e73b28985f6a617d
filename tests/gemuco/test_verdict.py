import numpy as np
import pytest
from muscle_arm import HIGH, LOW, MOST, MuscleArm
from tool_arm import ToolArm, dataset, tools

from gemuco.anomaly.blame import parts, suspects
from gemuco.anomaly.prediction import predict_error
from gemuco.anomaly.verdict import judge, window_score
from gemuco.intervals.regression import Fit
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.normal import Normal
from gemuco.schema import BodySchema

TOOLS = tools((0.2, 0.35, 0.5), (0.0, 0.8), (0.3,))
HELD, OTHER = "0.2/0.0/0.3", "0.5/0.8/0.3"


@pytest.fixture(scope="module")
def grips() -> BodySchema:
    """A model whose normal is of one tool."""
    masks = [("joint_position",), ("joint_position", "center_of_gravity")]
    config = TrainConfig(hidden=(50, 25), latent=8, bias_size=2, epochs=80, batch=100, rate=5e-3)
    outputs = ("center_of_gravity", "tool_tip_position")
    schema = fit(dataset(TOOLS, 300), config, masks, x_out=outputs)[0].under(HELD)
    errors = predict_error(schema, TOOLS[HELD].sample(1000, 3))
    return schema.with_normal(Normal.fit(errors, schema.scaler.std[schema.out_index]))


def rows(values: dict[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    return [{name: array[i] for name, array in values.items()} for i in range(len(values["joint_position"]))]


@pytest.mark.long
def test_the_tool_in_use_is_normal(grips):
    found = judge(grips, rows(TOOLS[HELD].walk(10, 5)))
    assert found.kind == "normal"
    assert found.blamed == ""
    assert np.array_equal(found.bias, grips.bias)


@pytest.mark.parametrize("condition", [c for c in TOOLS if c != HELD])
def test_another_tool_is_a_change_of_environment(grips, condition):
    found = judge(grips, rows(TOOLS[condition].walk(10, 6)))
    assert found.kind == "environment"
    assert found.explained < 1.0 < found.score
    assert window_score(grips.with_bias(found.bias), grips.normalise(TOOLS[condition].walk(50, 7))) < 1.2


def test_a_sensor_that_is_stuck_is_an_anomaly(grips):
    values = TOOLS[HELD].walk(20, 8, step=0.4)
    values["tool_tip_position"][:] = values["tool_tip_position"][0] + 0.2
    found = judge(grips, rows(values)[5:])
    assert found.kind == "anomaly"
    assert found.explained > 1.0
    assert found.blamed.startswith(("tool_tip_position", "joint_position"))


def test_a_tool_of_impossible_size_is_an_anomaly(grips):
    assert judge(grips, rows(ToolArm(2.5).walk(10, 9))).kind == "anomaly"


def test_without_parametric_bias_only_normal_and_anomaly(schema, arm):
    healthy = arm.sample(10, 55)
    assert judge(schema, rows(healthy)).kind == "normal"
    healthy["muscle_length"][:, 1] += 0.05  # m
    found = judge(schema, rows(healthy))
    assert found.kind == "anomaly"
    assert found.explained == found.score
    assert found.blamed.endswith(".back")


def test_nothing_to_judge_is_no_verdict(grips, schema, arm):
    assert judge(grips, []).kind == ""
    assert judge(schema.with_normal(None), rows(arm.sample(3, 1))).kind == ""
    assert suspects(schema.with_normal(None), np.zeros((3, 12))) == []
    assert suspects(schema, np.full((3, 12), np.nan)) == []


@pytest.mark.parametrize("muscle", range(5))
def test_a_window_blames_the_muscle_that_was_cut(schema, arm, muscle):
    values = arm.sample(200, 78)
    pulled = np.flatnonzero(values["muscle_tension"][:, muscle] > 50.0)[:10]  # N
    cut = {name: array[pulled] for name, array in values.items()}
    cut["muscle_tension"][:, muscle] = 0.0
    found = suspects(schema, schema.normalise(cut))[0]
    assert found.name.endswith(f".{schema.layout.signal('muscle_tension').elements[muscle]}")
    assert found.remains < 0.5


def test_a_joint_sensor_that_is_off_is_blamed_itself(schema, arm):
    values = arm.sample(10, 79)
    values["joint_position"][:, 0] += 0.5  # rad
    assert suspects(schema, schema.normalise(values))[0].name == "joint_position.shoulder"


def test_a_part_has_a_name_in_several_signals(schema, grips):
    assert parts(schema, list(range(12))) == [(2 + i, 7 + i) for i in range(5)]
    assert parts(grips, list(range(6))) == []  # `x` and `0` are no names


def beyond(arm: MuscleArm, share: float, seed: int) -> dict[str, np.ndarray]:
    """Samples of a healthy arm that turns its shoulder further than in the data, by a share of the learned range."""
    random = np.random.default_rng(seed)
    theta = random.uniform(LOW, HIGH, (10, 2))
    theta[:, 0] = HIGH[0] + share * (HIGH[0] - LOW[0]) + random.uniform(-0.02, 0.02, 10)
    tension = random.uniform(2.0, MOST, (10, 5))
    return {"joint_position": theta, "muscle_tension": tension, "muscle_length": arm.length(theta, tension)}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [0.2, 0.5])
def test_a_healthy_body_outside_of_what_was_learned_is_no_anomaly(schema, arm, share, seed):
    samples = rows(beyond(arm, share, seed))
    assert window_score(schema, schema.normalise(beyond(arm, share, seed))) > 1.0
    found = judge(schema, samples)
    assert (found.kind, found.blamed) == ("outside", "joint_position.shoulder")


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_a_sensor_that_lies_outside_of_what_was_learned_is_an_anomaly(schema, arm, share):
    values = beyond(arm, share, 3)
    values["muscle_length"][:, 1] += 0.06  # m
    assert judge(schema, rows(values)).kind == "anomaly"


def test_a_joint_sensor_that_shows_a_place_outside_of_what_was_learned_is_an_anomaly(schema, arm):
    values = arm.sample(10, 80)
    values["joint_position"][:, 0] = HIGH[0] + 0.5  # rad
    found = judge(schema, rows(values))
    assert (found.kind, found.blamed) == ("anomaly", "joint_position.shoulder")


def test_the_predictions_of_single_elements_outlast_a_change_of_the_model(schema, arm, monkeypatch):
    samples = rows(beyond(arm, 0.5, 0))
    assert judge(schema, samples).kind == "outside"
    monkeypatch.setattr(Fit, "of", None)  # would be computed at every step of an online update
    updated = schema.with_weights(schema.weights.replaced([array.copy() for array in schema.weights.arrays()]))
    updated.prepare(schema)
    assert judge(updated, samples).kind == "outside"
