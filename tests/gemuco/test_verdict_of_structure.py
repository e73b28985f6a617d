"""The verdict of structure determination: when it is reached, how it is stated, and that it is kept."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from muscle_arm import MuscleArm

import gemuco
from gemuco.dataset import Dataset, Episode
from gemuco.learning.config import TrainConfig
from gemuco.learning.network import first_weights
from gemuco.linear import LinearPath
from gemuco.signals import Layout, Signal
from gemuco.structure import determination, mask_training
from gemuco.structure.determination import Judge, Thresholds, determine
from gemuco.structure.inference import Split, infer_best
from gemuco.structure.mask_errors import MaskErrors
from gemuco.structure.mask_training import train_masks

TINY = TrainConfig(hidden=(20,), latent=5, epochs=3, batch=100)
SHORT = TrainConfig(hidden=(40, 20), latent=6, epochs=25, batch=100)
NAMES = ("a", "b", "c")
LAYOUT = Layout(tuple(Signal(name, 1, "m") for name in NAMES))


class Measured(MaskErrors):
    """Held-out rows whose errors are a table: mask -> error of each signal."""

    __slots__ = ("table",)

    def of(self, masks):
        return np.array([self.table[tuple(map(bool, line))] for line in masks])

    def in_units(self, masks):
        return 4.0 * self.of(masks)

    def from_others(self):
        return self.of(~np.eye(3, dtype=bool)).diagonal()

    def thinned(self, most):
        return self

    def halves(self):
        return self, self


def split_with(errors: dict[str, float], rest: float = 1.0) -> Measured:
    """A split in which the other signals infer each with an error; `from:signal` states that of another mask."""
    table = {}
    for code in range(1, 8):
        mask = tuple(bool(code >> place & 1) for place in range(3))
        line = []
        for place, name in enumerate(NAMES):
            label = "".join(n for n, inside in zip(NAMES, mask, strict=True) if inside)
            is_others = not mask[place] and sum(mask) == 2
            line.append(errors.get(f"{label}:{name}", errors.get(name, rest) if is_others else rest))
        table[mask] = line
    chain = first_weights(0, 6, 3, (4,), 2, "tanh").whole
    ones = np.ones((40, 3), np.float32)
    made = Measured(
        LAYOUT, chain, LinearPath.none(3, 3), ones, ones > 0, ones > 0, np.zeros((40, 0)), np.ones(3), np.full(3, 2.0)
    )
    object.__setattr__(made, "table", table)
    return made


@pytest.fixture
def splits(monkeypatch):
    """Replace training by splits with stated errors; the list that is returned counts those that were asked for."""
    asked = []

    def with_errors(errors):
        def train_split(_data, _config, split, *_rest):
            asked.append(split)
            return split_with(errors(split))

        monkeypatch.setattr(mask_training, "train_split", train_split)
        monkeypatch.setattr(determination, "cores", lambda: 1)
        return asked

    return with_errors


def body() -> Dataset:
    x = np.random.default_rng(0).normal(size=(60, 3))
    return Dataset(LAYOUT, (Episode("", {name: x[:, [i]] for i, name in enumerate(NAMES)}),))


def test_two_splits_are_enough_if_they_agree(splits):
    asked = splits(lambda split: {"a": 0.02 + 0.001 * split, "b": 0.03, "c": 0.9})
    found = determine(body(), TINY)
    assert asked == [0, 1]
    assert found.x_out == ("a", "b")
    assert found.open == ()
    assert found.spread_i["a"] == pytest.approx(0.0005)


def test_more_splits_until_the_spread_is_small_against_the_distance(splits):
    wild = [0.02, 0.12, 0.05, 0.08, 0.06, 0.07, 0.06, 0.07, 0.06, 0.07]
    asked = splits(lambda split: {"a": wild[split], "b": 0.01, "c": 0.9})
    found = determine(body(), TINY)
    assert 2 < len(asked) < 10
    assert found.splits == len(asked)
    assert "a" in found.x_out
    assert found.open == ()


@pytest.mark.parametrize("cores", [2, 3, 16])
def test_more_cores_train_more_splits_beside_each_other_and_change_nothing(splits, monkeypatch, cores):
    wild = [0.02, 0.12, 0.05, 0.08, 0.06, 0.07, 0.06, 0.07, 0.06, 0.07]

    def errors(split):
        return {"a": wild[split], "b": 0.01, "c": 0.9}

    asked = splits(errors)
    alone = determine(body(), TINY)
    asked.clear()
    monkeypatch.setattr(determination, "cores", lambda: cores)
    beside = determine(body(), TINY)
    assert beside == alone
    assert sorted(asked) == list(range(len(asked)))
    assert beside.splits <= len(asked) < beside.splits + cores


def test_an_error_at_the_threshold_ends_undecided_and_says_so(splits):
    asked = splits(lambda split: {"a": 0.14 + 0.1 * (-1) ** split, "b": 0.01, "c": 0.9})
    found = determine(body(), TINY)
    assert len(asked) == determination.MOST_SPLITS
    assert "a" in found.open
    assert "Undecided after 10 splits: L_i of a" in found.report()


def test_a_number_of_splits_is_kept(splits):
    asked = splits(lambda split: {"a": 0.14 + 0.1 * (-1) ** split, "b": 0.01, "c": 0.9})
    assert determine(body(), TINY, splits=4).splits == len(asked) == 4


def test_a_signal_is_an_output_if_one_mask_infers_it(splits):
    splits(lambda split: {"a": 0.3, "b:a": 0.01 + 0.001 * split, "b": 0.9, "c": 0.9})
    found = determine(body(), TINY)
    assert found.x_out == ("a",)
    assert found.best["a"] == frozenset("b")
    assert found.best["c"] == frozenset("ab")
    assert found.rms_i["a"] == pytest.approx(2.0 * np.sqrt(0.0105))
    assert "0.205 m" in found.report()


def test_the_best_of_many_masks_is_not_best_by_chance():
    random = np.random.default_rng(0)
    errors, least = [], []
    for _ in range(200):
        parts = [
            split_with({f"{m}:a": float(random.uniform(0.1, 0.3)) for m in ("b", "c", "bc")} | {"b": 1.0, "c": 1.0})
            for _ in range(2)
        ]
        errors.append(infer_best([Split(part) for part in parts]).shares[:, 0].mean())
        least.append(
            np.mean([part.of(np.array([[0, 1, 0], [0, 0, 1], [0, 1, 1]], bool)) for part in parts], 0)[:, 0].min()
        )
    assert np.mean(least) < 0.18
    assert np.mean(errors) == pytest.approx(0.2, abs=0.01)


def test_elimination_finds_the_signal_that_matters(monkeypatch):
    monkeypatch.setattr("gemuco.structure.inference.LISTED", 2)
    parts = [Split(split_with({"a": 0.2, "b:a": 0.05, "c:a": 0.6, "b": 0.9, "c": 0.9})) for _ in range(2)]
    found = infer_best(parts)
    assert found.masks[0].tolist() == [False, True, False]
    assert found.masks[1].tolist() == [True, False, True]
    assert found.shares[:, 0] == pytest.approx([0.05, 0.05])


@pytest.mark.slow
def test_nothing_is_refused_above_the_thresholds(data):
    found = determine(data, TINY, Thresholds(out=1e-9, into=1e-9), splits=2)
    assert found.is_poor
    assert found.poor == found.x_out
    assert found.masks
    assert found.feasible == ()
    report = found.report()
    for name in found.L_i:
        assert name in report
    assert "threshold_out 1e-09" in report
    assert "raise structure.threshold_out (Thresholds(out=...) in Python)" in report
    assert "raise structure.threshold_in" in report
    fine = determine(data, TINY, Thresholds(out=1.0, into=1e-9), splits=1)
    assert fine.poor == ()
    assert fine.is_poor
    assert "threshold_out" not in " ".join(fine.remarks)


def test_of_several_poor_signals_those_half_explained_are_kept(splits):
    splits(lambda _: {"a": 0.3, "b": 0.4, "c": 0.8, "bc:a": 0.3, "ac:b": 0.4})
    assert determine(body(), TINY).poor == ("a", "b")


def test_the_mark_is_kept_with_the_schema(monkeypatch, tmp_path):
    x = np.random.default_rng(0).normal(size=(400, 2))
    noisy = {"a": x[:, [0]], "b": x[:, [0]] + x[:, [1]]}
    monkeypatch.setattr(determination, "FIRST_SPLITS", 1)
    schema = gemuco.learn([noisy], replace(TINY, epochs=10), units={"a": "m", "b": "rad"})
    assert schema.manifest["poor"]
    gemuco.save(schema, tmp_path / "model")
    again = gemuco.load(tmp_path / "model")
    assert again.manifest["poor"] == schema.manifest["poor"]
    assert "x_out (poor)" in again.summary()
    assert "POOR:" in again.summary()
    json.loads((tmp_path / "model" / "manifest.json").read_text())


def test_the_report_states_errors_in_units_and_per_cent(structure):
    report = structure.report()
    for name, value in structure.L_i.items():
        line = next(line for line in report.splitlines() if line.startswith(name))
        assert f"{100.0 * np.sqrt(value):.0f}" in line
        assert f"{structure.rms_i[name]:.3g} {structure.layout.signal(name).unit}" in line
    spread = MuscleArm().sample(3000, 1)["joint_position"].std(axis=0).mean()
    stated = structure.rms_i["joint_position"]
    assert stated == pytest.approx(np.sqrt(structure.L_i["joint_position"]) * spread, rel=0.15)


def test_errors_by_unit_are_those_of_the_predictions(data):
    judge = Judge(data.layout.names, train_masks(data, TINY), Thresholds(1.0, 1.0))
    masks = np.array([[True, True, False], [False, True, True]])
    (errors,) = judge.errors
    squares = errors.in_units(masks)
    shares = errors.of(masks)
    for place, name in enumerate(data.layout.names):
        std = errors.scale[data.layout.slice(name)]
        assert np.all(squares[:, place] <= shares[:, place] * std.max() ** 2 * 1.01)
        assert np.all(squares[:, place] >= shares[:, place] * std.min() ** 2 * 0.99)


def smooth_arm(rows: int) -> dict[str, np.ndarray]:
    """Two joints that move between random postures, their cables and an unrelated signal."""
    random = np.random.default_rng(1)
    goals = random.uniform(-1.0, 1.0, (rows // 25 + 2, 2))
    share = np.linspace(0.0, 1.0, 25, endpoint=False)[:, None]
    path = 10 * share**3 - 15 * share**4 + 6 * share**5
    q = np.concatenate([a + (b - a) * path for a, b in pairwise(goals)])[:rows]
    cables = np.stack([np.sin(q[:, 0]), q[:, 0] + 0.5 * q[:, 1] ** 2, np.cos(q.sum(axis=1))], axis=1)
    other = np.cumsum(random.normal(size=(rows, 1)), axis=0)
    return {"joint": q, "cable": cables + 0.05 * random.normal(size=cables.shape), "other": other - other.mean()}


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_seeds_give_the_same_verdict():
    units = {"joint": "rad", "cable": "m", "other": "1"}
    verdicts = [determine(smooth_arm(900), replace(SHORT, seed=100 * seed), units=units).x_out for seed in range(5)]
    assert len(set(verdicts)) == 1
    assert "other" not in verdicts[0]
    assert "cable" in verdicts[0]
