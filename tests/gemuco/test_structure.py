import numpy as np
import pytest
from muscle_arm import LAYOUT

from gemuco.dataset import Dataset, Episode
from gemuco.errors import NotEnoughData, SchemaError
from gemuco.signals import Layout, Signal
from gemuco.structure import Thresholds, determine
from gemuco.train import TrainConfig

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
