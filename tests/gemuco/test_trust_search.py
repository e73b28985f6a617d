"""Searches for a cause: expensive, so an alarm whose cause cannot be hidden is not searched for in every block."""

import numpy as np
import pytest
from muscle_arm import MuscleArm

from gemuco.anomaly.healthy import learn_normal
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.schema import BodySchema
from gemuco.trust import monitor as trust
from gemuco.trust.cases import Case, LastSearch
from gemuco.trust.hypotheses import Cause
from gemuco.trust.monitor import AGAIN, RARELY, TrustMonitor

BEGIN, COUNT, SAMPLES, JOINT, OTHER = 120, 320, 5, 0, 8


def motion(arm: MuscleArm, blocks: int, seed: int) -> np.ndarray:
    """Return noisy samples of a motion, shape (blocks, SAMPLES, 12)."""
    draw = np.random.default_rng(seed)
    phase = draw.uniform(0, 6.0, 7) + np.arange(blocks * SAMPLES)[:, None] * draw.uniform(0.01, 0.03, 7)
    theta = np.array([0.0, 0.9]) + 0.6 * np.sin(phase[:, :2])
    tension = 50.0 + 40.0 * np.sin(phase[:, 2:])
    whole = np.concatenate([theta, tension, arm.length(theta, tension)], axis=1)
    noise = np.r_[np.full(2, 0.002), np.full(5, 0.3), np.full(5, 2e-4)]
    return (whole + draw.normal(0.0, 1.0, whole.shape) * noise).reshape(blocks, SAMPLES, 12)


@pytest.fixture(scope="module")
def model(data, arm) -> BodySchema:
    masks = [("joint_position", "muscle_tension"), ("muscle_tension", "muscle_length")]
    schema = fit(data, TrainConfig(hidden=(60, 20), latent=7, epochs=30, batch=100), masks)[0]
    rows = np.concatenate([motion(arm, 600, 100 + seed)[:, 0] for seed in range(8)])
    return schema.with_normal(learn_normal(schema, rows))


def searches(monkeypatch, monitor: TrustMonitor, samples: np.ndarray) -> list[int]:
    """Judge samples [standard deviations]; return the numbers of the blocks in which a cause was searched for."""
    made, search = [], trust.explain
    monkeypatch.setattr(trust, "explain", lambda *args: made.append(monitor._count) or search(*args))
    for index, block in enumerate(samples):
        monitor.add(block, 0.1 * index)
    return made


def test_a_lie_that_cannot_be_hidden_is_searched_for_now_and_then_and_a_second_one_at_once(model, arm, monkeypatch):
    samples = motion(arm, COUNT, 3)
    samples[BEGIN:, :, JOINT] += 0.3  # rad
    samples[BEGIN + 102 :, :, OTHER] += 0.02  # m
    monitor = TrustMonitor(model, replaces=lambda elements: False)
    made = searches(monkeypatch, monitor, model.scaler.normalise(samples))
    alone = [count for count in made if BEGIN + 20 < count <= BEGIN + 102]
    assert len(alone) <= 82 / AGAIN + 1
    assert any(BEGIN + 102 < count <= BEGIN + 106 for count in made)
    assert not monitor.hidden
    assert {JOINT, OTHER} <= {element for finding in monitor.findings for element in finding.elements}


@pytest.mark.long
def test_a_body_that_is_not_known_is_searched_rarely(model, arm, monkeypatch):
    samples = motion(arm, COUNT, 4)
    samples[BEGIN:, :, JOINT] += 0.3  # rad
    monitor = TrustMonitor(model, replaces=lambda elements: False)
    monitor.is_known = False
    monkeypatch.setattr("gemuco.trust.monitor.ACQUAINTED", np.inf)
    made = [count for count in searches(monkeypatch, monitor, model.scaler.normalise(samples)) if count > BEGIN]
    alone = [count for count in made if count > BEGIN + 20]
    assert any(count <= BEGIN + 6 for count in made)
    assert 1 <= len(alone) <= (COUNT - BEGIN - 20) / RARELY + 2


@pytest.mark.long
def test_while_elements_come_and_go_a_cause_is_searched_for_now_and_then(model, arm, monkeypatch):
    samples, draw = motion(arm, COUNT, 5), np.random.default_rng(0)
    samples[BEGIN:, :, 7:] *= 1.0 + np.array([0.03, -0.04, 0.05, -0.03, 0.04])  # of no single element
    for block in samples[BEGIN - 10 : BEGIN + 100]:
        block[:, draw.choice(12, draw.integers(1, 6), replace=False)] = np.nan
    monitor = TrustMonitor(model)
    monitor.is_known = False
    made = searches(monkeypatch, monitor, model.scaler.normalise(samples))
    within = [count for count in made if BEGIN < count <= BEGIN + 100]
    assert 0 < len(within) <= 100 / AGAIN


def test_the_last_search_answers_for_what_it_was_asked() -> None:
    element = Case(Cause(frozenset({1}), "element", 1), 0, 0, 0)
    body = Case(Cause(frozenset(), "body", 1), 0, 0, 0)
    search, alarm, wider = LastSearch(), np.array([0.0, 2.0, 0.5]), np.array([0.0, 2.0, 1.5])
    assert search.answer([element], np.zeros(3), is_due=False) is None
    assert search.answer([element], alarm, is_due=False) is None  # it may be hidden when it was seen once more
    element.reason = "the model cannot replace it"
    assert search.answer([element], alarm, is_due=False) is element
    assert search.answer([element], wider, is_due=False) is None
    assert search.answer([element], wider, is_due=False) is element
    assert search.answer([element], wider, is_due=True) is None
    element.is_hidden = True
    assert search.answer([element], alarm, is_due=False) is None
    assert search.answer([element, body], wider, is_due=False) is body
