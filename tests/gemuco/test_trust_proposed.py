"""An online update that sees a lie moves p; sensors are judged by the p so far until the new one explains all."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_trust_jumps import ERROR, JOINT, LEARNED, LOAD, SIZE, TIP, after, evidence, motion
from test_trust_tools import CHANGE, LAYOUT, SAMPLES, TOOLS, body, model, walk

from gemuco.trust.config import BLOCK
from gemuco.trust.evidence import Evidence
from gemuco.trust.hypotheses import Signs, explain
from gemuco.trust.jumps import moved_alone
from gemuco.trust.monitor import TrustMonitor
from gemuco.trust.tool import JudgedTool

__all__ = ["model"]
FAR = 3.0
"""Distance of a p that no tool has [range of the trained ones]."""


def judged(model, rows, proposed):
    """Judge all samples, with p as the update has it from the change on; return hidden elements and the p in use."""
    monitor, hidden = TrustMonitor(model), set()
    for number, block in enumerate(model.scaler.normalise(rows).reshape(-1, SAMPLES, LAYOUT.size)):
        if number >= CHANGE:
            monitor.use(proposed)
        monitor.add(block, number * BLOCK)
        hidden |= {LAYOUT.element(index) for index in monitor.hidden}
    return hidden, monitor._tool.schema.bias


def moved(model, share):
    """Return the model with a p that has gone this share of the way to the long tool and beyond."""
    short, long = (model.biases[name].astype(float) for name in TOOLS)
    return model.with_bias(short + share * (long - short))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2, 3))])
def test_a_lie_is_found_though_the_update_has_taken_it_for_a_tool(model, seed):
    rows = body(walk(400, 20 + seed), TOOLS["short"])
    rows[CHANGE * SAMPLES :, 0] += 0.5
    hidden, bias = judged(model, rows, moved(model, -FAR))
    assert hidden == {"joint_position.shoulder"}
    np.testing.assert_array_equal(bias, model.bias)


def test_a_tool_that_the_update_has_recognised_is_judged_by(model):
    position = walk(400, 30)
    rows = np.r_[body(position[: CHANGE * SAMPLES], TOOLS["short"]), body(position[CHANGE * SAMPLES :], TOOLS["long"])]
    hidden, bias = judged(model, rows, model.under("long"))
    assert not hidden
    np.testing.assert_array_equal(bias, model.biases["long"])


def test_a_tool_explains_the_sensors_after_a_while_and_a_model_without_p_has_none_to_doubt(model):
    tool = JudgedTool(model)
    assert not tool.has_explained
    tool.calm = 6.0
    assert tool.has_explained
    tool.propose(model.under("long"))
    tool.accept(10.0)
    assert not tool.has_explained, "another tool has explained nothing yet"
    tool.calm += 6.0
    tool.propose(moved(model, 1.05))
    tool.accept(20.0)
    assert tool.has_explained, "p of the same tool"
    without = SimpleNamespace(bias=np.zeros(0))
    assert JudgedTool(without).has_explained


def test_what_contradicts_nothing_is_followed_and_the_weights_at_once(model):
    tool, near = JudgedTool(model), moved(model, 0.05)
    tool.propose(near)
    assert tool.proposed is near and not tool.is_another
    np.testing.assert_array_equal(tool.schema.bias, model.bias)
    tool.accept(40.0)
    assert tool.schema is near and tool.proposed is None and tool.seen_for(50.0) == 50.0
    tool.propose(moved(model, FAR))
    assert tool.is_another
    tool.accept(60.0)
    assert tool.seen_for(70.0) == 10.0, "another tool is new to it"


def test_of_many_elements_of_one_signal_all_jump_and_a_knock_is_none() -> None:
    samples, signals = motion(LEARNED + 15), np.array([0, 1, 1, 1])
    samples[LEARNED + 12 :, :, JOINT:] += 0.5
    assert after(samples).jumped(3, ERROR, signals) == {JOINT, LOAD, TIP}
    assert not after(samples).sudden(3, ERROR), "no one of them is alone"
    samples[LEARNED + 12 :, :, 0] += 0.5
    assert not after(samples).jumped(3, ERROR, signals), "a knock at the body"


def test_what_did_not_jump_when_others_did_has_not_begun_to_lie() -> None:
    alarm, right = evidence(JOINT, TIP), lambda hidden: evidence() if JOINT in hidden else alarm
    blamed = explain(alarm, right, (), (), frozenset())
    assert blamed.columns == {JOINT}
    spared = explain(alarm, right, (), (), frozenset(), Signs(jumped=frozenset({TIP})))
    assert spared.cause == "body", "it explains the alarm, but the tip has jumped"
    assert explain(alarm, right, (), (), frozenset(), Signs(jumped=frozenset({JOINT}))).columns == {JOINT}


def test_a_device_whose_values_all_jump_is_the_cause_and_no_one_of_them() -> None:
    alarm, jumped = evidence(JOINT, LOAD, TIP), frozenset({JOINT, LOAD, TIP})

    def right(hidden: frozenset[int]) -> Evidence:
        return evidence() if JOINT in hidden else alarm

    cause = explain(alarm, right, (jumped,), (), frozenset(), Signs(jumped=jumped))
    assert (cause.cause, cause.columns) == ("all", jumped)
    assert explain(alarm, right, (frozenset({JOINT, LOAD}),), (), frozenset(), Signs(jumped=jumped)).cause == "body"


def test_the_only_one_that_moves_while_all_others_rest_is_named() -> None:
    values = np.zeros((6, SIZE))
    assert not moved_alone(values, ERROR)
    values[:, LOAD] = np.linspace(0.0, 0.5, 6)
    assert moved_alone(values, ERROR) == {LOAD}
    assert moved_alone(values, ERROR, frozenset({LOAD})) == {LOAD}, "it drifted out of what was learned"
    assert not moved_alone(values, ERROR, frozenset({JOINT})), "a wire was cut"
    values[:, TIP] = np.linspace(0.0, 0.2, 6)
    assert not moved_alone(values, ERROR), "the body moves"
