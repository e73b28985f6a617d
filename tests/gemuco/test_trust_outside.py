"""A healthy body where its model knows nothing is no lie of a sensor: an arm that turns further than it has learned."""

import numpy as np
import pytest

from gemuco.anomaly.healthy import learn_normal
from gemuco.dataset import Dataset, Episode
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.signals import Layout, Signal
from gemuco.trust.config import BLOCK
from gemuco.trust.monitor import TrustMonitor

LAYOUT = Layout((Signal("joint_position", 3, "rad"), Signal("tool_tip_position", 3, "m", ("x", "y", "z"))))
LOW, HIGH = np.array([-1.2, -1.0, -1.0]), np.array([1.2, 1.0, 1.0])
LEARNED = np.array([0.0, 1.0, 1.0])
"""The first joint was at most here [rad]."""
SAMPLES, SPEED, NOISE = 5, 1.5, 1e-3


def body(position, seed):
    """Return all elements at joint positions [rad], shape (n, 6), with the noise of the tip."""
    pan, first, both = position[:, 0], position[:, 1], position[:, 1] + position[:, 2]
    reach = 0.2 + 0.3 * np.cos(first) + 0.3 * np.cos(both)
    tip = np.stack([reach * np.cos(pan), reach * np.sin(pan), 0.3 * np.sin(first) + 0.3 * np.sin(both)], axis=1)
    return np.concatenate([position, tip + NOISE * np.random.default_rng(seed).standard_normal(tip.shape)], axis=1)


def walk(blocks, seed, high):
    """Return joint positions [rad] that go to random targets at full speed, shape (blocks * SAMPLES, 3)."""
    random, step = np.random.default_rng(seed), SPEED * BLOCK / SAMPLES
    now = goal = np.array([-0.5, 0.0, 0.0])
    walked = []
    for _ in range(blocks * SAMPLES):
        if np.array_equal(now, goal):
            goal = random.uniform(LOW, high)
        now = np.where(np.abs(goal - now) <= step, goal, now + np.sign(goal - now) * step)
        walked.append(now)
    return np.array(walked)


@pytest.fixture(scope="module")
def model():
    rows = body(np.random.default_rng(0).uniform(LOW, LEARNED, (2000, 3)), 1)
    episodes = [Episode("", LAYOUT.split(part)) for part in np.array_split(rows, 8)]
    schema = fit(Dataset(LAYOUT, tuple(episodes)), TrainConfig(epochs=30), (("joint_position",),))[0]
    return schema.with_normal(learn_normal(schema, body(walk(600, 50, LEARNED), 2)[::5]))


def watched(model, rows):
    """Judge all samples; return the hidden elements after each block."""
    monitor, hidden = TrustMonitor(model), []
    for number, block in enumerate(model.scaler.normalise(rows).reshape(-1, SAMPLES, LAYOUT.size)):
        monitor.add(block, number * BLOCK)
        hidden.append({LAYOUT.element(index) for index in monitor.hidden})
    return hidden


def hidden_in(model, rows):
    """Judge all samples; return the block at which each hidden element was hidden first."""
    first = {}
    for number, names in enumerate(watched(model, rows)):
        for name in names:
            first.setdefault(name, number)
    return first


@pytest.mark.parametrize("seed", [0, 1, 2, 10, 11, 16, 25])
def test_no_sensor_is_hidden_where_nothing_was_learned(model, seed):
    position = np.concatenate([walk(200, seed, LEARNED), walk(600, 10 + seed, HIGH)])
    assert (position[:, 0] > 0.3).mean() > 0.2
    assert hidden_in(model, body(position, seed)) == {}


def go(position, goal):
    """Return the way from a position to a goal [rad] at full speed, shape (samples, 3)."""
    step, way = SPEED * BLOCK / SAMPLES, [position]
    while not np.array_equal(way[-1], goal):
        left = goal - way[-1]
        way.append(np.where(np.abs(left) <= step, goal, way[-1] + np.sign(left) * step))
    return np.array(way[1:])


@pytest.mark.parametrize("off", [0.05, 0.3])
def test_a_lie_that_began_there_is_hidden_when_the_body_is_back(model, off):
    random, parts = np.random.default_rng(100), [walk(200, 0, LEARNED)]
    outside = np.array([0.8, 0.2, 0.3])
    parts += [go(parts[-1][-1], outside), np.repeat(outside[None], 10 * SAMPLES, axis=0)]
    back = sum(map(len, parts))
    while sum(map(len, parts)) < back + 60 * SAMPLES:
        parts.append(go(parts[-1][-1], random.uniform(LOW, LEARNED)))
    rows = body(np.concatenate(parts), 0)[: (back + 60 * SAMPLES) // SAMPLES * SAMPLES]
    rows[back - 5 * SAMPLES :, 1] += off
    hidden = watched(model, rows)
    start = next(number for number, names in enumerate(hidden) if names)
    assert "joint_position.1" in hidden[start] and start <= back // SAMPLES + 50
    assert hidden[start + 3 :] == [{"joint_position.1"}] * len(hidden[start + 3 :]), "another one at most for a moment"


@pytest.mark.parametrize("seed", range(3))
def test_a_joint_sensor_that_only_shows_such_a_place_is_hidden(model, seed):
    rows = body(walk(500, seed, LEARNED), seed)
    rows[400 * SAMPLES :, 0] += 1.2
    first = hidden_in(model, rows)
    assert list(first) == ["joint_position.0"]
    assert 400 <= first["joint_position.0"] <= 410
