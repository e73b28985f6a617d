"""The table of peers: one small row from end to end, honest verdicts, and peers that know what they should."""

import json
from functools import partial

import numpy as np
import pytest

pytest.importorskip("sklearn", reason="the peers need scikit-learn: make peers installs it")

from gemuco import TrainConfig
from studies.peers import contest, estimators, recordings
from studies.peers.__main__ import run, whole
from studies.peers.anomalies import Fault, Watched, area, shifted
from studies.peers.contest import Peers
from studies.peers.question import Bar, Body, Question, Trial
from studies.peers.table import Figures, Row, verdict, verdicts

MIXING = np.array([[1.0, -0.5], [0.3, 0.8]])


def rows_of(count: int, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Rows of a linear body: b = a MIXING + 0.3."""
    a = random.normal(size=(count, 2))
    return {"a": a, "b": a @ MIXING + 0.3}


def linear_trial(seed: int) -> Trial:
    random = np.random.default_rng(seed)
    return Trial({"default": [rows_of(20, random) for _ in range(10)]}, {"default": rows_of(50, random)})


def linear_body(bar: Bar, epochs: int) -> Body:
    def settings(seed):
        return TrainConfig(hidden=(8,), latent=2, epochs=epochs, batch=50, seed=seed)

    question = Question("b from a", "b", ("a",), "mm", 1e3, bar)
    return Body("linear", {"a": "m", "b": "m"}, linear_trial, [question], settings, "test", [("a",)], ("b",))


def test_a_row_is_measured_from_end_to_end(tmp_path, capsys):
    body = linear_body(Bar("best", 1.05), epochs=2)
    rows = run([(body, list(body.questions))], [], 2, Peers(tmp_path), True)
    (row,) = rows
    assert set(row.peers) == set(estimators.METHODS)
    assert row.best in ("ridge", "cubic_ridge", "iterative_imputer")
    assert row.peers["ridge"].mean(True) < 1e-3
    assert row.ours is not None and row.ours.mean(False) > 1.0, "two epochs cannot be good to 1 mm"
    assert row.is_met is False and "**NOT met**" in whole(rows) and "0 of 1 rows" in whole(rows)
    assert json.loads(json.dumps(row.record()))["is_met"] is False
    assert "linear" in capsys.readouterr().out


def test_only_cached_peers_are_shown_without_computation(tmp_path):
    body = linear_body(Bar("best", 1.05), epochs=1)
    (empty,) = contest.estimates(body, body.questions, 1, Peers(tmp_path, only_cached=True), True)
    assert not empty.peers and empty.is_met is None and verdict(empty) == "-"
    (computed,) = contest.estimates(body, body.questions, 1, Peers(tmp_path), False)
    (cached,) = contest.estimates(body, body.questions, 1, Peers(tmp_path, only_cached=True), True)
    assert cached.peers == computed.peers and computed.ours is None


def test_missing_recordings_are_skipped_with_their_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GEMUCO_DATA", str(tmp_path / "nowhere"))
    recordings.kuka.cache_clear()
    body = next(b for b in recordings.bodies() if b.name.startswith("kuka"))
    assert run([(body, list(body.questions))], [], 1, Peers(tmp_path), True) == []
    assert "nowhere/kuka_kr300" in capsys.readouterr().err


def test_a_refusal_is_no_estimate_and_not_met(tmp_path):
    def noise(seed):
        return Trial(
            {"default": [{n: np.random.default_rng([seed, i]).normal(size=(60, 1)) for i, n in enumerate("ab")}]},
            {"default": {n: np.zeros((3, 1)) for n in "ab"}},
        )

    question = Question("b from a", "b", ("a",), "m", 1.0, Bar("best", 1.05))

    def settings(seed):
        return TrainConfig(hidden=(4,), latent=1, epochs=2, seed=seed)

    body = Body("noise", {"a": "m", "b": "m"}, noise, [question], settings, "test")
    (row,) = contest.estimates(body, [question], 1, Peers(tmp_path), True)
    assert row.is_met is False and "no estimate" in verdicts([row])
    assert row.record()["ours"] == {"unit": [None], "std": [None]} and row.record()["ratio"] is None
    assert row.refusal and row.refusal in verdicts([row])


@pytest.mark.parametrize(
    ("bar", "ours", "met"),
    [
        (Bar("best", 1.05), 0.104, True),
        (Bar("best", 1.05), 0.106, False),
        (Bar("gaussian_process", 3.0), 0.59, True),
        (Bar("gaussian_process", 3.0), 0.61, False),
        (Bar("at most", 0.02), 0.021, False),
        (Bar("if ridge", 0.02), 0.5, None),
        (Bar("if ridge", 0.15), 0.16, False),
        (Bar("at least", 0.15), 0.19, False),
        (Bar("at least", 0.15), 0.2, True),
        (Bar("at least", 0.92), 0.9, False),
        (Bar("best", 1.05), float("nan"), False),
        (Bar("at least", 0.1), float("nan"), False),
    ],
)
def test_verdicts(bar, ours, met):
    peers = {name: Figures((value,), (value,)) for name, value in (("ridge", 0.1), ("gaussian_process", 0.2))}
    assert Row("body", "question", "m", bar, peers, Figures((ours,), (ours,))).is_met is met


def test_the_error_of_a_question_is_in_both_units():
    trial = Trial({"x": [{"b": np.array([[0.0], [2.0]])}]}, {"x": {"b": np.zeros((2, 1))}})
    question = Question("b", "b", (), "mm", 1e3, Bar("best", 1.0))
    assert question.judge(trial, np.array([[0.5], [0.5]])) == pytest.approx((500.0, 0.5))


def test_peers_know_the_condition(tmp_path):
    random = np.random.default_rng(0)

    def rows(count: int, gain: float) -> dict[str, np.ndarray]:
        a = random.normal(size=(count, 1))
        return {"a": a, "b": gain * a}

    gains = {"light": 1.0, "heavy": -1.0}
    trial = Trial(
        {name: [rows(20, gain) for _ in range(10)] for name, gain in gains.items()},
        {name: rows(40, gain) for name, gain in gains.items()},
    )
    question = Question("b from a", "b", ("a",), "m", 1.0, Bar("best", 1.05))
    errors = Peers(tmp_path).errors(question, trial, ("a", "b"), 0)
    assert max(std for _, std in errors.values()) < 0.5, errors
    assert errors["ridge"][1] < 1e-3


def test_ridge_solves_more_inputs_than_rows():
    random = np.random.default_rng(1)
    x = random.normal(size=(30, 60))
    (weights, offset), *_ = estimators.solve(x, x[:, :1] + 2.0, np.array([1e-8]))
    assert np.abs(x @ weights + offset - x[:, :1] - 2.0).max() < 1e-3


def test_the_gaussian_process_does_not_end_in_pure_noise():
    random = np.random.default_rng(4)
    x = random.normal(size=(200, 7))
    y = np.sin(x[:, :1]) + 0.3 * x[:, 1:2] * x[:, 2:3]
    none = np.zeros(200, int)
    problem = estimators.Problem(x, y, np.zeros((200, 0)), none, none, x[:50] * 0.9, none[:50], 0)
    truth = np.sin(problem.query[:, :1]) + 0.3 * problem.query[:, 1:2] * problem.query[:, 2:3]
    assert np.abs(estimators.METHODS["gaussian_process"](problem) - truth).mean() < 0.05


def test_an_anomaly_is_scored_by_every_detector(tmp_path):
    random = np.random.default_rng(2)

    def watched(seed: int) -> Watched:
        healthy = rows_of(60, random)
        noisy = [{n: v + 0.01 * random.normal(size=v.shape) for n, v in rows_of(30, random).items()} for _ in range(8)]
        return Watched(noisy, healthy, {"off": shifted("b", 0, 0.5, healthy)})

    fault = Fault("linear, off", {"a": "m", "b": "m"}, watched, Bar("at least", 0.9), (1, 10))
    single, window = contest.detections(fault, fault.windows, 1, Peers(tmp_path), False)
    assert set(single.peers) == set(contest.DETECTORS)
    assert single.peers["ridge_residual"].mean(False) > 0.99
    assert window.question == "means of 10 samples" and single.best in contest.DETECTORS


def test_area_counts_ties_as_half_and_refuses_missing_scores():
    assert area(np.array([1.0, 2.0]), np.array([1.0, 0.0])) == pytest.approx(0.875)
    assert np.isnan(area(np.array([np.nan]), np.array([1.0])))
    assert area(np.array([0.0, 3.0]), np.array([1.0, 1.0]), window=2) == 1.0


def test_rows_are_held_out_as_whole_blocks():
    random = np.random.default_rng(3)
    trial = Trial({"x": [rows_of(100, random), rows_of(8, random)]}, {"x": rows_of(5, random)})
    question = Question("b from a", "b", ("a",), "m", 1.0, Bar("best", 1.0))
    x, y, others, condition, block, query, asked = contest.problem(question, trial, ("a", "b"))
    assert x.shape == (108, 2) and y.shape == (108, 2) and others.shape == (108, 0) and query.shape == (5, 2)
    assert len(np.unique(block)) == 11 and (np.diff(block) >= 0).all()
    held = estimators.Problem(x, y, others, condition, block, query, asked, 0).held_out()
    assert all(held[block == b].all() or not held[block == b].any() for b in np.unique(block))


def test_no_test_row_is_a_training_row_of_the_robots():
    from studies.peers import robots

    trial = robots.trial("kxr_humanoid", False, 0)
    known = {row.tobytes() for row in trial.learned("joint_position")}
    assert not known & {row.tobytes() for row in trial.judged("joint_position")}
    assert partial(robots.trial, "kxr_humanoid", True)(0).judged("tool_tip_pixel").shape == (600, 2)
