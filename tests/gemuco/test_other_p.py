"""A p that is not one of the trained ones, and one that does not explain what is seen."""

import numpy as np
import pytest
from tool_arm import MASKS, ToolArm, dataset, tools

from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.recognise import Prior
from gemuco.adaption.update import Updater
from gemuco.anomaly.verdict import judge
from gemuco.certainty.certainty import NINETY
from gemuco.estimation import estimate
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.schema import BodySchema

TOOLS = tools((0.2, 0.35, 0.5), (0.0, 0.8), (0.3,))
HELD, OTHER = "0.2/0.0/0.3", "0.5/0.8/0.3"


@pytest.fixture(scope="module")
def grips() -> BodySchema:
    config = TrainConfig(hidden=(50, 25), latent=8, bias_size=2, epochs=80, batch=100, rate=5e-3)
    return fit(dataset(TOOLS, 300), config, MASKS)[0].under(HELD)


def followed(schema: BodySchema, arm: ToolArm, count: int = 40) -> Updater:
    """Update p by samples of a motion."""
    updater, values = Updater(schema, UpdateConfig(what="bias")), arm.walk(count, 5)
    for index in range(count):
        updater.add({name: array[index] for name, array in values.items()})
        updater.result = updater.step()
    return updater


def tip(schema: BodySchema, arm: ToolArm) -> tuple[np.ndarray, np.ndarray, str, str]:
    """Error and std of the hidden tip on other postures [m], shape (n, 2), and the state and reason of the first."""
    values = arm.sample(200, 77)
    prediction = estimate(schema, {"joint_position": values["joint_position"]})["tool_tip_position"]
    return prediction.value - values["tool_tip_position"], prediction.std, prediction.state[0], prediction.reason[0]


def test_a_trained_tool_is_settled_and_known(grips):
    updater = followed(grips, TOOLS[OTHER])
    assert updater.result.settled
    missed, std, state, _ = tip(updater.schema, TOOLS[OTHER])
    assert state == "known"
    assert (np.abs(missed) <= NINETY * std).mean() > 0.8


def test_a_tool_between_the_trained_ones_is_not_unknown(grips):
    updater = followed(grips, ToolArm(0.4, 0.4, 0.3))
    missed, std, state, _ = tip(updater.schema, ToolArm(0.4, 0.4, 0.3))
    assert state in ("known", "doubtful")
    assert (np.abs(missed) <= NINETY * std).mean() > 0.7


@pytest.mark.parametrize("arm", [ToolArm(1.0, 0.0, 0.3), ToolArm(1.2, 0.8, 0.3)], ids=["twice", "bent"])
def test_a_tool_of_twice_the_length_is_never_said_to_be_known(grips, arm):
    updater = followed(grips, arm)
    missed, std, state, reason = tip(updater.schema, arm)
    assert state != "known"
    assert "no known condition" in reason or "no p explains what is seen" in reason
    assert (np.abs(missed) <= NINETY * std).mean() > 0.5
    assert np.sqrt(np.mean(missed**2)) < 3.0 * np.sqrt(np.mean(std**2))
    is_beyond = Prior.of(grips).is_beyond(updater.schema.bias.astype(float))
    assert is_beyond or not updater.result.settled


def test_a_body_that_no_p_explains_is_not_settled(grips):
    updater = followed(grips, ToolArm(0.35, 0.0, 0.3, bend=0.6))
    assert not updater.result.settled


def test_the_verdict_on_a_p_beyond_the_trained_ones_is_unknown(grips):
    prior = Prior.of(grips)
    beyond = prior.mean + 4.0 * (prior.known[0] - prior.mean)
    assert prior.is_beyond(beyond) and not prior.is_beyond(prior.known[0])
    other = grips.with_bias(beyond)
    values = TOOLS[HELD].walk(20, 5)
    x = other.normalise(values)
    predicted = other.infer(x, frozenset({"joint_position"})) * other.scaler.std[other.out_index]
    predicted = predicted + other.scaler.mean[other.out_index]
    imagined = {name: predicted[:, span] for name, span in other.out_layout.slices.items()}
    rows = [{name: array[i] for name, array in (values | imagined).items()} for i in range(20)]
    assert judge(other, rows).kind in ("unknown", "anomaly")
    assert judge(grips, rows).kind in ("unknown", "anomaly")


def test_elements_that_were_not_measured_since_the_change_are_doubtful(grips):
    updater = Updater(grips, UpdateConfig(what="bias"))
    before, after = TOOLS[HELD].walk(15, 5), TOOLS[OTHER].walk(15, 6)
    for values, names in ((before, tuple(before)), (after, ("joint_position", "tool_tip_position"))):
        for index in range(15):
            updater.add({name: values[name][index] for name in names})
            updater.step()
    given = {"joint_position": after["joint_position"][0], "tool_tip_position": after["tool_tip_position"][0]}
    prediction = estimate(updater.schema, given)["center_of_gravity"]
    assert prediction.state == "doubtful"
    assert prediction.reason == "the body changed, and center_of_gravity.0 was not measured since"
    given = {"joint_position": after["joint_position"][0], "center_of_gravity": after["center_of_gravity"][0]}
    assert estimate(updater.schema, given)["tool_tip_position"].state == "known"
