"""The Musashi experiments in small: recordings of arms that break on the way, fits, areas, geometric data."""

from pathlib import Path

import numpy as np
import pytest

from gemuco.signals import Layout
from hal.config import load_robot
from services.learning.trainer import train
from studies.paper.musashi import anomaly, model
from studies.paper.musashi.control import OURS, WEIGHTS, controls
from studies.paper.musashi.motion import LENGTH, POSITION, SENT, TENSION, record, signals

ROBOT = load_robot(Path(__file__).parents[2] / "robots" / "musashi_arm.yaml")


@pytest.fixture(scope="module")
def cut():
    return record(ROBOT, arm=0, seed=1, duration=3.0, parts=((1.0, "muscle_cut:biceps"),))


def test_a_recording_holds_what_was_sent_and_what_broke(cut):
    recorded = signals(cut)
    assert tuple(recorded) == (POSITION, TENSION, LENGTH, SENT)
    biceps = ROBOT.signals[TENSION].elements.index("biceps")
    tension = recorded[TENSION][:, biceps]
    assert tension[:8].min() > 5.0
    assert np.abs(tension[18:]).max() < 5.0
    assert np.abs(recorded[SENT] - recorded[LENGTH]).max() < 0.01


def test_only_what_follows_a_cut_is_judged(cut):
    assert len(anomaly.since_cut(cut)) == len(cut) - 20


def test_the_same_seed_is_the_same_recording(cut):
    again = record(ROBOT, arm=0, seed=1, duration=3.0, parts=((1.0, "muscle_cut:biceps"),))
    assert np.array_equal(cut.rows(), again.rows())


def test_the_area_under_a_roc_curve_counts_pairs():
    assert anomaly.area(np.array([2.0, 3.0]), np.array([0.0, 1.0])) == 1.0
    assert anomaly.area(np.array([0.0, 1.0]), np.array([0.0, 1.0])) == 0.5
    assert anomaly.area(np.array([0.5]), np.array([0.0, 1.0])) == 0.5


def test_an_exponential_is_found_again():
    time = np.arange(1.0, 601.0)
    fit = model.decay(time, 0.1 + 0.24 * np.exp(-time / 80.0))
    assert fit.at(0.0) == pytest.approx(0.34, abs=0.005)
    assert fit.at(600.0) == pytest.approx(0.1, abs=0.002)
    assert model.decay(time, 0.3 * np.exp(-time / 900.0), has_floor=False).floor == 0.0


def test_geometric_data_are_random_states_in_episodes(monkeypatch):
    monkeypatch.setattr(model, "SAMPLES", 1000)
    data = model.geometric_data(ROBOT, 0)
    assert len(data) == 1000
    assert len(data.episodes) == 10
    tension = data.layout.split(data.rows())[TENSION]
    assert 10.0 <= tension.min() < 15.0
    assert 175.0 < tension.max() <= 180.0


@pytest.mark.slow
def test_the_structure_of_a_training_is_read_from_its_model(monkeypatch):
    monkeypatch.setattr(model, "SAMPLES", 1000)
    trained = train(ROBOT, model.geometric_data(ROBOT, 0), 0, lambda done, text: None)
    known = model.structure_of(ROBOT, trained.schema)
    for fact in ("layout", "x_in", "x_out", "masks", "L_i", "L_m", "thresholds"):
        assert getattr(known, fact) == getattr(trained.structure, fact)


def test_paper_and_robot_file_differ_in_their_weights_alone():
    ours, paper = controls(ROBOT)[OURS], controls(ROBOT)[WEIGHTS]
    assert (ours.route, ours.mask) == (paper.route, paper.mask)
    assert [term.weight for term in paper.terms] == [None, 1.0, 0.01]


def test_recordings_are_of_the_robots_signals(cut):
    assert isinstance(cut.layout, Layout)
    assert cut.layout.signal(SENT).unit == ROBOT.signals[LENGTH].unit
