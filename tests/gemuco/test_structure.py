import numpy as np
import pytest
from muscle_arm import LAYOUT

from gemuco.dataset import Dataset, Episode
from gemuco.errors import NotEnoughData, SchemaError
from gemuco.layers import run
from gemuco.learning.train import TrainConfig
from gemuco.masks import all_masks, bits
from gemuco.signals import Layout, Signal
from gemuco.structure import determination as structures
from gemuco.structure import mask_judge
from gemuco.structure.determination import Judge, Thresholds, determine, select
from gemuco.structure.mask_errors import MaskErrors
from gemuco.structure.mask_judge import BAD, HEATS, SURE, TOLD, Judged
from gemuco.structure.mask_training import train_masks
from gemuco.structure.row_draw import Heat, RowDraw

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


def test_measure_and_outputs_are_options(data, structure):
    options = Thresholds(out=1.0, into=1.0, measure="rmse", over="all")
    config = TrainConfig(hidden=(60, 20), latent=7, epochs=30, batch=100)
    wide = determine(data, config, options)
    assert frozenset(LAYOUT.names) not in wide.L_m
    assert len(wide.masks) == 6
    for name, value in structure.L_i.items():
        assert wide.L_i[name] == pytest.approx(np.sqrt(value), rel=1e-5)
    assert "root mean square error" in wide.report()


def test_says_what_is_wrong_with_thresholds(data):
    with pytest.raises(SchemaError, match="Known: mse, rmse"):
        Thresholds(measure="mae")
    with pytest.raises(SchemaError, match=r"threshold_in is 1\.2; it must be above 0, and at most 1"):
        Thresholds(into=1.2)
    with pytest.raises(SchemaError, match="threshold_out is nan"):
        Thresholds(out=float("nan"))
    with pytest.raises(NotEnoughData, match="smallest L_i"):
        determine(data, TINY, Thresholds(out=1e-9))
    with pytest.raises(NotEnoughData, match="smallest L_m"):
        determine(data, TINY, Thresholds(out=1.0, into=1e-9))


def test_an_output_that_no_mask_infers_is_remarked(data):
    found = determine(data, SHORT, Thresholds(out=1.0, into=0.15))
    remark = next(r for r in found.remarks if r.startswith("'muscle_tension' is an output, but no feasible mask"))
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
    with pytest.raises(NotEnoughData, match="Signal 'b' never varies"):
        determine(made_of(a=x, b=np.ones((300, 3))), TINY)
    with pytest.raises(NotEnoughData, match="Signal 'b' was never measured"):
        determine(made_of(a=x, b=np.full((300, 3), np.nan)), TINY)


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


def test_more_splits_average_over_what_is_held_out(data):
    one = determine(data, TINY, Thresholds(1.0, 1.0))
    two = determine(data, TrainConfig(hidden=(20,), latent=5, epochs=3, batch=100, seed=1), Thresholds(1.0, 1.0))
    told = []
    both = determine(data, TINY, Thresholds(1.0, 1.0), lambda share, _: told.append(share), splits=2)
    for name, value in both.L_i.items():
        assert value == pytest.approx((one.L_i[name] + two.L_i[name]) / 2)
    assert told == sorted(told)
    assert told[-1] == 1.0


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


@pytest.fixture(scope="module", params=["seed 0", "seed 1", "seed 2", "gaps", "arm"])
def measured(request, data) -> tuple[Layout, tuple[MaskErrors, ...]]:
    """Networks that were trained for structure determination, and what they say of masks."""
    kind, _, seed = request.param.partition(" ")
    if kind == "arm":
        return data.layout, train_masks(data, SHORT, 2)
    body = many_signals(int(seed or 3), 0.02 if kind == "gaps" else 0.0)
    return body.layout, train_masks(body, QUICK, 2 if kind == "gaps" else 1)


def every_mask(layout: Layout) -> np.ndarray:
    return np.array([bits(m, layout.names) > 0 for m in all_masks(layout.names)])


def test_errors_of_masks_are_those_of_the_network(measured):
    layout, (errors, *_) = measured
    masks = every_mask(layout)
    found = errors.of(masks)
    for mask, line in zip(masks, found, strict=True):
        rows = errors.whole[:, mask].all(axis=1)
        truth, there = errors.x[rows], errors.there[rows]
        tail = np.broadcast_to(mask.astype(np.float32), (len(truth), len(mask)))
        given = np.repeat(mask, [signal.size for signal in layout.signals])
        told = run(errors.chain, np.concatenate([truth * given, tail, errors.p[rows]], axis=1))
        for index, name in enumerate(layout.names):
            span = layout.slice(name)
            missed = np.where(there[:, span], (told - truth)[:, span] ** 2, 0.0).sum(axis=0) / there[:, span].sum(
                axis=0
            )
            assert line[index] == pytest.approx(missed.sum() / errors.liveliness[span].sum(), rel=1e-3, abs=1e-6)
    assert errors.amounts == pytest.approx([errors.liveliness[layout.slice(name)].sum() for name in layout.names])


def few_rows_tell(errors: MaskErrors, mask: np.ndarray, heat: Heat) -> tuple[np.ndarray, np.ndarray]:
    """Squares of the first rows, shape (rows, size), and what makes weighted sums of them errors, shape (size,)."""
    rows = len(heat)
    (squared,) = errors.squares(mask[None])
    counts = errors.whole[:rows, mask].all(axis=1)[:, None] & errors.there[:rows]
    count, share = counts.sum(axis=0), heat.weights @ counts
    factor = np.full(len(share), np.nan)
    for name in errors.layout.names:
        span = errors.layout.slice(name)
        alive = errors.liveliness[span] > 0.0
        scarce = (count[span] < TOLD) | (share[span] < 0.5 * count[span] / rows)
        if not (scarce & alive).any() and alive.any():
            factor[span] = 1.0 / (np.where(scarce, 1.0, share[span]) * errors.liveliness[span].sum())
    return squared[:rows].astype(float), factor


def test_first_rows_tell_known_means_exactly_and_all_others_nearly(measured):
    layout, (errors, *_) = measured
    _, others = errors.from_others()
    draw = RowDraw(others.sum(axis=2), 0)
    drawn = errors.rows(draw.order)
    heat = draw.heat(len(errors.x) // 4)
    assert heat.weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(heat.weights @ heat.known, [1.0] + [0.0] * (heat.known.shape[1] - 1), atol=1e-9)
    masks = every_mask(layout)
    told = []
    for mask in masks:
        squared, factor = few_rows_tell(drawn, mask, heat)
        told.append(drawn.by_signal(heat.weights @ squared * factor))
    told = np.array(told)
    truth = errors.of(masks)
    clear = np.isfinite(told) & (truth > 0.05)
    assert clear.mean() > 0.3
    assert np.median(np.abs(told / truth - 1.0)[clear]) < 0.15


def test_rows_that_are_known_to_be_bad_are_drawn_first():
    random = np.random.default_rng(0)
    known = random.random((5, 300)) ** 2
    known[:, 40:50] = 100.0
    found = np.stack([np.argsort(RowDraw(known, seed).order)[40:50] for seed in range(20)])
    assert np.median(found) < 20  # of 300


def test_estimates_of_first_rows_spread_as_they_say():
    """Errors that are skewed and partly like known ones: seldom off by two standard errors, and less than at random."""
    random, off, missed = np.random.default_rng(0), [], []
    for seed in range(200):
        known = random.gamma(0.5, size=(4, 400))
        value = (known.T @ random.random(4)) * random.gamma(2.0, size=400)
        draw = RowDraw(known, seed)
        heat, drawn = draw.heat(100), value[draw.order][:100]
        left = drawn - heat.known @ (drawn @ heat.project)
        missed.append((heat.weights @ drawn - value.mean(), random.choice(value, 100, False).mean() - value.mean()))
        off.append(missed[-1][0] / np.sqrt(heat.doubt @ left**2))
    assert np.mean(np.abs(off) > 2.0) < 0.1
    assert 0.7 < np.std(off) < 1.3  # skewed: above what a normal one has
    ours, at_random = np.sqrt(np.mean(np.square(missed), axis=0))
    assert ours < 0.7 * at_random


def test_rows_without_known_errors_are_drawn_alike():
    heat = RowDraw(np.zeros((3, 200)), 0).heat(100)
    np.testing.assert_allclose(heat.weights, 0.01)


@pytest.mark.parametrize("measure", ["mse", "rmse"])
@pytest.mark.parametrize("over", ["masked", "all"])
@pytest.mark.parametrize("share", [0.2, 0.4, 0.7])
def test_a_race_finds_what_the_full_measurement_finds(measured, measure, over, share, monkeypatch):
    layout, errors = measured
    judge = Judge(layout.names, errors, Thresholds(1.0, 1.0, measure, over))
    masks = every_mask(layout)
    masks = masks[judge.is_judged(masks)]
    order, count = np.sort(judge.of(masks).L_m), int(share * len(masks))
    into = float(order[count - 1 : count + 1].mean())  # so many are feasible
    judge = Judge(layout.names, errors, Thresholds(1.0, into, measure, over))
    full, raced = judge.of(masks), judge.race(masks)
    is_rough = raced.is_rough.copy()
    np.testing.assert_array_equal(raced.L_m < into, full.L_m < into)
    np.testing.assert_allclose(raced.L_m[~is_rough], full.L_m[~is_rough], rtol=1e-5)
    np.testing.assert_allclose(raced.squared[~is_rough], full.squared[~is_rough], rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(raced.L_m[is_rough], full.L_m[is_rough], rtol=0.5)
    judge.finish(raced, np.arange(0, len(masks), 2))
    np.testing.assert_array_equal(raced.is_rough[1::2], is_rough[1::2])
    assert not raced.is_rough[::2].any()
    np.testing.assert_allclose(raced.L_m[::2], full.L_m[::2], rtol=1e-5)
    np.testing.assert_allclose(raced.squared[::2], full.squared[::2], rtol=1e-4, atol=1e-7)
    kept = []
    for outright in (0, 99):
        monkeypatch.setattr(structures, "OUTRIGHT", outright)
        kept.append(select(layout, judge, every_mask(layout), True, 0))
    race, whole = kept
    assert set(race.feasible) == set(whole.feasible)
    assert not whole.rough
    assert not race.rough & set(race.masks)
    assert [race.L_m[m] for m in race.masks] == pytest.approx([whole.L_m[m] for m in race.masks], rel=1e-5)
    assert race.rough <= {frozenset(np.array(layout.names)[line].tolist()) for line in masks[is_rough]}


def verdict(judge: Judge, mask: np.ndarray, count: int) -> tuple[np.ndarray, bool]:
    """What so many rows tell of a mask, written out: errors of all signals, shape (signals,), and if it is out."""
    mean, variance, hidden, heats = np.zeros(len(mask)), 0.0, 0.0, [draw.heat(count) for draw in judge._draws]
    weight = np.where(judge.outputs & ~mask, np.max([split.amounts for split in judge.errors], axis=0), 0.0)
    weight /= weight.sum()
    for split, heat in zip(judge.errors, heats, strict=True):
        squared, factor = few_rows_tell(split, mask, heat)
        mean += split.by_signal(heat.weights @ squared * factor) / len(heats)
        value = squared @ np.nan_to_num(np.repeat(weight, split.sizes) * factor)
        left = value - heat.known @ (value @ heat.project)
        variance += heat.doubt @ left**2 / len(heats) ** 2
        hidden += (value * heat.hidden).max() / len(heats)
    mean = np.maximum(mean, 0.0)
    over, spread = np.nan_to_num(mean) @ weight - judge.thresholds.into, SURE * np.sqrt(variance)
    is_known = np.isfinite(mean[weight > 0.0]).all()
    return mean, is_known and (over > spread or over + BAD * hidden < -spread)


@pytest.mark.parametrize("heats", [HEATS, (20, 290)])  # the last is longer than a block of rows
def test_a_race_goes_by_the_formulas(measured, heats, monkeypatch):
    layout, errors = measured
    monkeypatch.setattr(mask_judge, "HEATS", heats)
    judge = Judge(layout.names, errors, Thresholds(1.0, 0.3))
    masks = every_mask(layout)
    judged = judge.race(masks[judge.is_judged(masks)])
    heats = [rows for rows in heats if 4 * rows <= 3 * min(len(split.x) for split in judge.errors)]
    assert set(np.unique(judged.done)) <= {-1, *heats}
    assert judged.is_rough.any()
    for mask, squared, done in zip(judged.masks, judged.squared, judged.done, strict=True):
        told = [verdict(judge, mask, rows) for rows in heats if done < 0 or rows <= done]
        assert [is_out for _, is_out in told] == [False] * (len(told) - 1) + [done >= 0]
        if done >= 0:
            np.testing.assert_allclose(squared, told[-1][0], rtol=1e-4, atol=1e-6)


def test_a_mask_that_a_race_misjudged_is_not_kept(measured, monkeypatch):
    layout, errors = measured
    judge = Judge(layout.names, errors, Thresholds(1.0, 0.4))
    monkeypatch.setattr(structures, "OUTRIGHT", 99)
    whole = select(layout, judge, every_mask(layout), True, 0)
    honest = judge.race

    def flattering(masks):
        raced = honest(masks)
        nothing, zeros = np.zeros_like(raced.done), np.zeros_like(raced.total)
        return Judged(masks, raced.L_m * 0.01, raced.squared * 0.01, np.ones_like(raced.is_rough), zeros, nothing)

    monkeypatch.setattr(structures, "OUTRIGHT", 0)
    monkeypatch.setattr(judge, "race", flattering)
    found = select(layout, judge, every_mask(layout), True, 0)
    assert found.masks
    assert set(found.masks) <= set(whole.feasible)
    assert not found.rough & set(found.masks)
    assert [found.L_m[m] for m in found.masks] == [whole.L_m[m] for m in found.masks]


def test_most_masks_are_told_from_few_rows_and_the_report_says_so():
    body = many_signals(0)
    found = determine(body, QUICK, Thresholds(0.5, 0.15))
    assert 0.5 * len(found.L_m) < len(found.rough) < len(found.L_m)
    assert not found.rough & set(found.masks)
    report = found.report()
    assert f"L_m of {len(found.rough)} masks, marked ~, is an estimate from few rows" in report
    assert any(" ~0." in line for line in report.splitlines())
