"""Another tool is no lie of a sensor: a hand with a camera that takes a longer tool, at once and unannounced."""

import numpy as np
import pytest

from gemuco.anomaly.healthy import learn_normal
from gemuco.dataset import Dataset, Episode
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.signals import Layout, Signal
from gemuco.trust.cases import Case
from gemuco.trust.config import BLOCK
from gemuco.trust.hypotheses import Cause
from gemuco.trust.monitor import TrustMonitor

TOOLS = {"short": 0.1, "long": 0.25}
LAYOUT = Layout(
    (
        Signal("joint_position", 2, "rad", ("shoulder", "elbow")),
        Signal("center_of_gravity", 2, "m", ("x", "y")),
        Signal("tool_tip_position", 2, "m", ("x", "y")),
    )
)
SAMPLES, SPEED = 5, 2.0
CHANGE = 300
"""Block of the change."""


def body(position, tool):
    """Return all elements at joint positions [rad], shape (n, 6)."""
    first, both, reach = position[:, 0], position.sum(axis=1), 0.2 + tool
    tip = np.stack([0.3 * np.cos(first) + reach * np.cos(both), 0.3 * np.sin(first) + reach * np.sin(both)], axis=1)
    return np.concatenate([position, 0.1 * (tip - [0.5, 0.0]), tip], axis=1)


def walk(blocks, seed):
    """Return joint positions [rad] that go to random targets at full speed, shape (blocks * SAMPLES, 2)."""
    random, step = np.random.default_rng(seed), SPEED * BLOCK / SAMPLES
    now = goal = np.array([0.2, -0.3])
    walked = []
    for _ in range(blocks * SAMPLES):
        if np.array_equal(now, goal):
            goal = random.uniform([-0.6, -1.0], [0.9, 1.0])
        now = np.where(np.abs(goal - now) <= step, goal, now + np.sign(goal - now) * step)
        walked.append(now)
    return np.array(walked)


@pytest.fixture(scope="module")
def model():
    random, episodes, normal = np.random.default_rng(0), [], []
    for condition, tool in TOOLS.items():
        rows = body(random.uniform([-0.6, -1.0], [0.9, 1.0], (800, 2)), tool)
        episodes += [Episode(condition, LAYOUT.split(part)) for part in np.array_split(rows, 6)]
    config = TrainConfig(hidden=(30, 20), latent=6, bias_size=2, epochs=15, batch=100)
    masks = (("joint_position",), ("joint_position", "center_of_gravity"))
    schema = fit(Dataset(LAYOUT, tuple(episodes)), config, masks)[0].under("short")
    for seed in range(4):
        normal.append(body(walk(150, 50 + seed), TOOLS["short"]))
    return schema.with_normal(learn_normal(schema, np.concatenate(normal)))


def judged(model, rows, recognised=None):
    """Judge all samples; return every element that was hidden, and the conditions that were named."""
    monitor, hidden, named = TrustMonitor(model), set(), set()
    blocks = model.scaler.normalise(rows).reshape(-1, SAMPLES, LAYOUT.size)
    for number, block in enumerate(blocks):
        if number == recognised:
            monitor.use(model.under("long"))
        monitor.add(block, number * BLOCK)
        hidden |= {LAYOUT.element(index) for index in monitor.hidden}
        named |= {finding.condition for finding in monitor.findings if finding.cause == "environment"}
    return hidden, named


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.long
def test_another_tool_is_named_and_no_sensor_is_hidden_for_it(model, seed):
    position = walk(500, seed)
    rows = np.r_[body(position[: CHANGE * SAMPLES], TOOLS["short"]), body(position[CHANGE * SAMPLES :], TOOLS["long"])]
    hidden, named = judged(model, rows, recognised=CHANGE + 30)
    assert not hidden
    assert "long" in named


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.long
def test_sensors_are_judged_by_the_tool_that_an_update_recognises_long_after_the_change(model, seed):
    """Errors with the wrong tool may be taken for healthy by then, and only one tool was ever normal."""
    position, change, recognised = walk(CHANGE + 170, 80 + seed), CHANGE * SAMPLES, CHANGE + 150
    rows = np.r_[body(position[:change], TOOLS["short"]), body(position[change:], TOOLS["long"])]
    monitor = TrustMonitor(model)
    for number, block in enumerate(model.scaler.normalise(rows).reshape(-1, SAMPLES, LAYOUT.size)):
        if number == recognised:
            monitor.use(model.under("long"))
        monitor.add(block, number * BLOCK)
        if number == recognised + 10:
            np.testing.assert_array_equal(monitor._bench.schema.bias, model.under("long").bias)


def test_no_lie_is_gross_before_the_tool_has_explained_all_sensors(model):
    """An update learns from no sample while a lie is gross, so a wrong p could never be mended."""
    monitor, rows = TrustMonitor(model), body(walk(400, 90), TOOLS["short"])
    case = Case(Cause(frozenset({0}), "element", 0), 1, 1, 1, is_gross=True)
    seen = []
    for number, block in enumerate(model.scaler.normalise(rows).reshape(-1, SAMPLES, LAYOUT.size)):
        monitor.add(block, number * BLOCK)
        seen.append(monitor._finding(case).is_gross)
        if number == CHANGE:
            monitor._bench.tool.propose(model.under("long"))
            monitor._bench.tool.accept(monitor._bench.healthy.moved)
            assert not monitor._finding(case).is_gross, "another tool has explained nothing yet"
    assert not any(seen[:5])
    assert all(seen[CHANGE - 20 : CHANGE])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.long
def test_an_encoder_that_lies_is_not_taken_for_a_tool(model, seed):
    rows = body(walk(400, 20 + seed), TOOLS["short"])
    rows[CHANGE * SAMPLES :, 0] += 0.5
    hidden, _ = judged(model, rows)
    assert hidden == {"joint_position.shoulder"}


def at_rest(seed):
    """Return joint positions [rad] that move for 30 s and then rest for 15 s, with noise."""
    moving = walk(CHANGE, seed)
    rest = np.repeat(moving[-1:], 150 * SAMPLES, axis=0)
    return np.r_[moving, rest] + np.random.default_rng(seed).normal(0.0, 0.001, (len(moving) + len(rest), 2))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.long
def test_no_sensor_is_hidden_for_another_tool_at_rest(model, seed):
    position, change = at_rest(60 + seed), (CHANGE + 50) * SAMPLES
    rows = np.r_[body(position[:change], TOOLS["short"]), body(position[change:], TOOLS["long"])]
    hidden, _ = judged(model, rows, recognised=CHANGE + 80)
    assert not hidden


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2))])
def test_an_encoder_that_drifts_at_rest_is_not_taken_for_a_tool(model, seed):
    rows, begin = body(at_rest(60 + seed), TOOLS["short"]), (CHANGE + 30) * SAMPLES
    rows[begin:, 0] += 0.01 * BLOCK / SAMPLES * np.arange(len(rows) - begin)
    hidden, _ = judged(model, rows)
    assert "joint_position.shoulder" in hidden
    assert len(hidden) <= 2


def test_a_pair_of_an_element_and_p_is_described_by_the_element(model):
    monitor, rows = TrustMonitor(model), body(walk(60, 40), TOOLS["short"])
    rows[200:, 0] += 0.5
    for number, block in enumerate(model.scaler.normalise(rows).reshape(-1, SAMPLES, LAYOUT.size)):
        monitor.add(block, number * BLOCK)
    p = LAYOUT.size
    case = Case(Cause(frozenset({0, p}), "all", p), 41, 41, 60)
    monitor._describe(case, case.cause.columns, is_noise=False)
    assert case.kind == "offset"
    assert case.size == pytest.approx(0.5, abs=0.2)
    alone = Case(Cause(frozenset({p}), "element", p), 41, 41, 60)
    monitor._describe(alone, alone.cause.columns, is_noise=False)
    assert alone.kind == "unknown"
