import os
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from muscle_arm import LAYOUT

from gemuco.dataset import Dataset, Episode
from gemuco.errors import NotEnoughData, SchemaError
from gemuco.layers import run
from gemuco.learning.train import TrainConfig
from gemuco.masks import all_masks, bits
from gemuco.signals import Layout, Signal
from gemuco.structure.determination import Judge, Thresholds, determine, select
from gemuco.structure.mask_errors import MaskErrors
from gemuco.structure.mask_training import train_masks

TINY = TrainConfig(hidden=(20,), latent=5, epochs=3, batch=100)
SHORT = TrainConfig(hidden=(40, 20), latent=6, epochs=25, batch=100)


def test_finds_the_structure_of_a_muscle_driven_arm(structure):
    assert {"joint_position", "muscle_length"} <= set(structure.x_out)
    assert frozenset({"joint_position", "muscle_tension"}) in structure.masks
    assert frozenset({"muscle_tension", "muscle_length"}) in structure.masks
    assert frozenset({"muscle_tension"}) not in structure.masks
    assert structure.L_i["muscle_tension"] > structure.L_i["joint_position"]
    report = structure.report()
    assert "muscle_tension+muscle_length" in report
    assert "x_in  = joint_position, muscle_tension, muscle_length" in report


def test_a_narrow_report_has_all_masks_without_the_errors_of_single_signals(structure):
    wide, narrow = (structure.report(width) for width in (200, 80))
    heads = [next(line for line in report.splitlines() if line.startswith("mask")) for report in (wide, narrow)]
    assert wide == structure.report()
    assert ["muscle_length [m]" in head for head in heads] == [True, False]
    first = narrow.splitlines().index(heads[1])
    table = narrow.splitlines()[first : first + 1 + len(structure.listed)]
    assert [line.split()[0] for line in table[1:]] == [
        "+".join(n for n in LAYOUT.names if n in m) for m in structure.listed
    ]
    assert max(map(len, table)) <= 80
    assert all(line.endswith(("yes", "no", "poor")) for line in table[1:])


@pytest.mark.slow
def test_measure_and_outputs_are_options(data, structure):
    options = Thresholds(out=1.0, into=1.0, measure="rmse", over="all")
    config = TrainConfig(hidden=(60, 20), latent=7, epochs=30, batch=100)
    wide = determine(data, config, options)
    assert frozenset(LAYOUT.names) not in wide.L_m
    assert len(wide.masks) == 6
    for name, value in structure.L_i.items():
        assert wide.L_i[name] == pytest.approx(np.sqrt(value), rel=1e-5)
    assert "root mean square error" in wide.report()


@pytest.mark.parametrize(("splits", "trained"), [(None, 0.6), (3, 0.7)])
def test_progress_grows_with_the_trainings_and_not_at_the_end_at_once(data, splits, trained):
    shares = []
    determine(data, TINY, progress=lambda done, text: shares.append((done, text)), splits=splits)
    values = [done for done, _ in shares]
    assert values[-1] == 1.0
    assert all(before <= after for before, after in pairwise(values))
    assert max(done for done, text in shares if "loss" in text) > trained


def test_says_what_is_wrong_with_thresholds(data):
    with pytest.raises(SchemaError, match="Known: mse, rmse"):
        Thresholds(measure="mae")
    with pytest.raises(SchemaError, match=r"threshold_in is 1\.2; it must be above 0, and at most 1"):
        Thresholds(into=1.2)
    with pytest.raises(SchemaError, match="threshold_out is nan"):
        Thresholds(out=float("nan"))


@pytest.mark.long
def test_an_output_that_no_mask_infers_is_remarked(data):
    found = determine(data, SHORT, Thresholds(out=1.0, into=0.15))
    remark = next(r for r in found.remarks if r.startswith("'muscle_tension' is an output, but every feasible mask"))
    assert remark in found.report()


def made_of(**signals: np.ndarray) -> Dataset:
    """Episodes of one-element or wider signals, shape (samples, n)."""
    layout = Layout(tuple(Signal(name, values.shape[1], "1") for name, values in signals.items()))
    count = len(next(iter(signals.values())))
    parts = np.array_split(np.arange(count), 10)
    return Dataset(layout, tuple(Episode("", {name: v[rows] for name, v in signals.items()}) for rows in parts))


def test_signals_about_which_there_is_nothing_to_say():
    x = np.random.default_rng(0).normal(size=(300, 2))
    with pytest.raises(NotEnoughData, match="There is one signal, 'a', and nothing to infer it from"):
        determine(made_of(a=x), TINY)
    with pytest.raises(NotEnoughData, match=r"one signal, 'a'.*Signal 'b' never varies"):
        determine(made_of(a=x, b=np.ones((300, 3))), TINY)
    with pytest.raises(NotEnoughData, match=r"one signal, 'a'.*Signal 'b' was never measured"):
        determine(made_of(a=x, b=np.full((300, 3), np.nan)), TINY)
    with pytest.raises(NotEnoughData, match="There are no samples"):
        determine(Dataset(made_of(a=x, b=x).layout, ()), TINY)


def test_a_dead_signal_is_left_out_and_named():
    x = np.random.default_rng(0).normal(size=(300, 2))
    found = determine(made_of(a=x, b=x + 0.1, c=np.ones((300, 1))), TINY, Thresholds(1.0, 1.0), splits=1)
    assert set(found.L_i) == {"a", "b"}
    assert found.layout.names == ("a", "b", "c")
    assert "Signal 'c' never varies" in found.report()


def test_channels_that_hardly_move_do_not_make_a_signal_look_inferred():
    random = np.random.default_rng(0)
    x = random.normal(size=(1500, 2))
    dull = np.concatenate([random.normal(size=(1500, 1)), 1e-3 * random.normal(size=(1500, 7)), np.ones((1500, 2))], 1)
    found = determine(made_of(a=x, b=x + 0.3 * np.sin(x), dull=dull), SHORT)
    assert found.x_out == ("a", "b")
    assert found.L_i["dull"] > 0.8
    assert found.L_m[frozenset({"a"})] < 0.1


def test_samples_that_lack_a_signal_judge_the_masks_they_can():
    random = np.random.default_rng(0)
    x = random.normal(size=(2000, 2))
    a, b, c = x.copy(), x + 0.3 * np.sin(x), x @ [[1.0, 0.5], [-0.5, 1.0]]
    a[0::2], c[1::2] = np.nan, np.nan  # a and c are never measured together
    found = determine(made_of(a=a, b=b, c=c), SHORT, Thresholds(out=0.5, into=0.5))
    assert frozenset({"b"}) in found.masks
    assert all(np.isfinite(found.L_m[frozenset({name})]) for name in "abc")
    assert found.L_m[frozenset({"a", "c"})] == np.inf


def test_each_sample_is_judged_under_the_bias_of_its_condition():
    random = np.random.default_rng(0)
    episodes = []
    for index in range(20):
        x = random.normal(size=(100, 2))
        tip = x * (0.3 if index % 2 else 2.0)
        episodes.append(Episode("long" if index % 2 else "short", {"a": x, "tip": tip}))
    data = Dataset(Layout((Signal("a", 2, "rad"), Signal("tip", 2, "m"))), tuple(episodes))
    config = TrainConfig(hidden=(40, 20), latent=6, epochs=60, batch=100, bias_size=2)
    assert determine(data, config, Thresholds(out=0.9, into=0.9)).L_i["tip"] < 0.05


@pytest.mark.slow
def test_more_splits_average_over_what_is_held_out(data):
    one = determine(data, SHORT, Thresholds(1.0, 1.0), splits=1)
    two = determine(data, replace(SHORT, seed=1), Thresholds(1.0, 1.0), splits=1)
    shares = []
    both = determine(data, SHORT, Thresholds(1.0, 1.0), lambda share, _: shares.append(share), splits=2)
    for mask, value in both.L_m.items():
        assert value == pytest.approx((one.L_m[mask] + two.L_m[mask]) / 2)
        assert both.spread_m[mask] == pytest.approx(abs(one.L_m[mask] - two.L_m[mask]) / 2)
        assert np.isnan(one.spread_m[mask])
    assert (one.splits, both.splits) == (1, 2)
    assert "+-" in both.report()
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


QUICK = TrainConfig(hidden=(40,), latent=8, epochs=12, batch=100, rate=2e-2, bias_size=1)


def many_signals(seed: int, gaps: float = 0.0) -> Dataset:
    """Seven signals of three hidden numbers under two conditions; a share of each is missing."""
    random = np.random.default_rng(seed)
    sizes = random.integers(1, 4, 7)
    mixing = random.normal(size=(3, sizes.sum())) * (random.random((3, sizes.sum())) < 0.7)
    layout = Layout(tuple(Signal(f"s{index}", int(size), "1") for index, size in enumerate(sizes)))
    episodes = []
    for index in range(16):
        hidden = random.normal(size=(250, 3)) * (1.0 + 0.3 * (index % 2))
        x = np.tanh(hidden @ mixing) + 0.2 * random.normal(size=(250, sizes.sum()))
        for name in layout.names:
            x[np.ix_(random.random(250) < gaps, np.arange(layout.size)[layout.slice(name)])] = np.nan
        episodes.append(Episode("one" if index % 2 else "other", layout.split(x)))
    return Dataset(layout, tuple(episodes))


@pytest.fixture(
    scope="module",
    params=["seed 0", *(pytest.param(f"seed {seed}", marks=pytest.mark.long) for seed in (1, 2)), "gaps", "arm"],
)
def measured(request, data) -> tuple[Layout, tuple[MaskErrors, ...]]:
    """Networks that were trained for structure determination, and what they say of masks."""
    kind, _, seed = request.param.partition(" ")
    if kind == "arm":
        return data.layout, train_masks(data, SHORT, 2)
    body = many_signals(int(seed or 3), 0.02 if kind == "gaps" else 0.0)
    return body.layout, train_masks(body, QUICK, 2 if kind == "gaps" else 1)


def every_mask(layout: Layout) -> np.ndarray:
    return np.array([bits(m, layout.names) > 0 for m in all_masks(layout.names)])


@pytest.mark.long
def test_errors_of_masks_are_those_of_the_network(measured):
    layout, (errors, *_) = measured
    masks = every_mask(layout)
    found = errors.of(masks)
    for mask, shares in zip(masks, found, strict=True):
        rows = errors.whole[:, mask].all(axis=1)
        truth, there = errors.x[rows], errors.counts[rows]
        tail = np.broadcast_to(mask.astype(np.float32), (len(truth), len(mask)))
        given = np.repeat(mask, [signal.size for signal in layout.signals])
        line = errors.path.map(given.astype(float))
        code = (truth * given) @ line[:-1] + line[-1]
        prediction = run(errors.chain, np.concatenate([truth * given, code, tail, errors.p[rows]], axis=1))
        for index, name in enumerate(layout.names):
            span = layout.slice(name)
            missed = np.where(there[:, span], (prediction - truth)[:, span] ** 2, 0.0).sum(axis=0) / there[:, span].sum(
                axis=0
            )
            assert shares[index] == pytest.approx(missed.sum() / errors.liveliness[span].sum(), rel=1e-3, abs=1e-6)
    assert errors.amounts == pytest.approx([errors.liveliness[layout.slice(name)].sum() for name in layout.names])


@pytest.mark.parametrize("measure", ["mse", "rmse"])
@pytest.mark.parametrize("over", ["masked", "all"])
def test_error_of_a_mask_is_that_of_its_outputs(measured, measure, over):
    layout, errors = measured
    judge = Judge(layout.names, errors, Thresholds(1.0, 1.0, measure, over))
    masks = every_mask(layout)
    masks = masks[judge.is_judged(masks)]
    L_m, squared = judge.measure(masks)
    amounts = np.max([split.amounts for split in judge.errors], axis=0)
    for mask, error, line in zip(masks, L_m, squared, strict=True):
        counted = judge.outputs & (~mask if over == "masked" else True) & np.isfinite(line)
        mean = (line * amounts)[counted].sum() / amounts[counted].sum()
        assert error == pytest.approx(mean if measure == "mse" else np.sqrt(mean), rel=1e-6)


@pytest.mark.parametrize("share", [0.2, 0.4, 0.7])
@pytest.mark.long
def test_feasible_are_the_masks_below_the_threshold(measured, share):
    layout, errors = measured
    judge = Judge(layout.names, errors, Thresholds(1.0, 1.0))
    masks = every_mask(layout)
    masks = masks[judge.is_judged(masks)]
    order, count = np.sort(judge.measure(masks)[0]), int(share * len(masks))
    into = float(order[count - 1 : count + 1].mean())
    structure = select(layout, Judge(layout.names, errors, Thresholds(1.0, into)), masks, True, 0)
    assert len(structure.L_m) == len(masks)
    assert len(structure.feasible) == count
    assert set(structure.masks) <= set(structure.feasible)
    errors_of_kept = [structure.L_m[m] for m in structure.masks]
    assert errors_of_kept == sorted(errors_of_kept)


def test_number_of_cores_changes_nothing(measured, monkeypatch):
    layout, (errors, *_) = measured
    results = []
    for count in (1, 2, 5):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, count=count: set(range(count)))
        results.append(errors.of(every_mask(layout)))
    np.testing.assert_array_equal(results[1], results[0])
    np.testing.assert_array_equal(results[2], results[0])
