"""The std of an estimate and its state, inside and outside of what was learned."""

import json
import time
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from muscle_arm import HIGH, LAYOUT, LOW
from tool_arm import MASKS, ToolArm, tools
from tool_arm import dataset as tool_data

from gemuco import checkpoint
from gemuco.adaption.update import Updater
from gemuco.certainty.certainty import NINETY, Certainty
from gemuco.checkpoint import load, save
from gemuco.compiled.certainty import grown, novelties, spread
from gemuco.dataset import Dataset, Episode
from gemuco.errors import SchemaError
from gemuco.estimation import estimate
from gemuco.intervals.calibration import fitted
from gemuco.intervals.region import Region
from gemuco.learning.train import TrainConfig, fit
from gemuco.scaler import Scaler
from gemuco.signals import Layout, Signal

FL = [{"joint_position", "muscle_tension"}, {"muscle_tension", "muscle_length"}]


def hidden(values, name):
    return {signal: array.copy() for signal, array in values.items() if signal != name}


def row(values, index):
    return {signal: array[index] for signal, array in values.items()}


def judged(schema, values, name):
    """Errors and std of a hidden signal [standard deviations], both of shape (samples, n), and the states."""
    estimated = estimate(schema, hidden(values, name))[name]
    scale = schema.scaler.std[schema.layout.slice(name)]
    return (estimated.value - values[name]) / scale, estimated.std / scale, estimated.state


def test_nine_of_ten_errors_of_fresh_samples_are_inside_of_the_interval(schema, arm):
    values = arm.sample(1500, 77)
    for name in ("joint_position", "muscle_length"):
        missed, std, state = judged(schema, values, name)
        covered = (np.abs(missed) <= NINETY * std).mean(axis=0)
        assert (covered > 0.85).all() and (covered < 0.95).all(), (name, covered)
        assert (state == "unknown").mean() < 0.02


def test_the_interval_holds_near_the_edge_of_the_data_where_a_constant_one_does_not(schema, arm):
    values = arm.sample(4000, 78)
    share = np.minimum(values["joint_position"] - LOW, HIGH - values["joint_position"]) / (HIGH - LOW)
    edge = share.min(axis=1) < np.quantile(share.min(axis=1), 0.1)
    missed, std, _ = judged(schema, values, "muscle_length")
    assert 0.85 < (np.abs(missed[edge]) <= NINETY * std[edge]).mean() < 0.95
    constant = np.quantile(np.abs(missed), 0.9, axis=0)
    assert (np.abs(missed[edge]) <= constant).mean() < 0.85


def test_a_value_out_of_its_range_is_unknown_with_the_reason(schema, arm):
    values = hidden(row(arm.sample(1, 5), 0), "muscle_length")
    inside = estimate(schema, values)["muscle_length"]
    assert (inside.state, inside.reason) == ("known", "")
    values["joint_position"][1] = 2.4
    outside = estimate(schema, values)["muscle_length"]
    assert outside.state == "unknown"
    assert outside.reason.startswith("outside of the range of joint_position.elbow: 2.4 rad, learned to 1.")
    assert (outside.std > 2.0 * inside.std).all()
    values["joint_position"][1] = 1e6
    assert (estimate(schema, values)["muscle_length"].std > 1e3).all()  # m


def test_given_values_of_no_body_are_not_known(schema, arm):
    """Every value is in its range, but no posture has these lengths."""
    values = arm.sample(300, 6)
    values["muscle_length"] = np.random.default_rng(1).permuted(values["muscle_length"], axis=0)
    assert (judged(schema, values, "joint_position")[2] != "known").mean() > 0.9


@pytest.mark.long
def test_what_is_not_declared_unknown_is_right_beyond_the_learned_half_of_a_joint(arm):
    learned = arm.sample(6000, 9)
    half = learned["joint_position"][:, 1] < 0.9
    data = Dataset(LAYOUT, (Episode("new", {name: array[half] for name, array in learned.items()}),))
    schema = fit(data, TrainConfig(hidden=(60, 20), latent=7, epochs=60, batch=100), FL)[0]
    values = arm.sample(1000, 10)
    far = values["joint_position"][:, 1] > 1.0
    for name in ("joint_position", "muscle_length"):
        missed, std, state = judged(schema, values, name)
        is_said = state != "unknown"
        assert (state[far] == "unknown").mean() > 0.5
        assert (np.abs(missed[far & is_said]) < 1.5).all()
        assert np.sum(missed[far & is_said] ** 2) <= 0.25 * max(1, missed[far & is_said].size)
        assert std[far].mean() > 2.0 * std[~far].mean()


def test_a_measured_signal_is_known_and_nothing_at_all_is_not(schema, arm):
    values = row(arm.sample(1, 5), 0)
    for estimated in estimate(schema, values).values():
        assert (estimated.state, estimated.reason) == ("known", "")
    for estimated in estimate(schema, {}).values():
        assert estimated.state == "unknown"
        assert estimated.reason == "nothing that it could be estimated from was measured"


@pytest.fixture(scope="module")
def grips():
    config = TrainConfig(hidden=(50, 25), latent=8, bias_size=2, epochs=60, batch=100, rate=5e-3)
    return fit(tool_data(tools((0.2, 0.5), (0.0, 0.8), (0.8,)), 300), config, MASKS)[0]


def test_a_p_of_no_known_condition_is_said_and_widens_the_interval(grips):
    values = hidden(row(ToolArm(0.2, 0.0, 0.8).sample(1, 3), 0), "tool_tip_position")
    own = estimate(grips.under("0.2/0.0/0.8"), values)["tool_tip_position"]
    mean = estimate(grips, values)["tool_tip_position"]
    assert (own.state, own.reason) == ("known", "")
    assert mean.state in ("doubtful", "unknown")
    assert "p is of no known condition; the nearest, '" in mean.reason
    assert (mean.std > 2.0 * own.std).all()
    sure = grips.with_bias(grips.bias, 1e-6 * np.eye(2))
    assert (estimate(sure, values)["tool_tip_position"].std < mean.std).all()


def test_a_mean_p_is_as_wrong_as_it_promises(grips):
    for condition, arm in tools((0.2, 0.5), (0.0, 0.8), (0.8,)).items():
        values = arm.sample(300, 31)
        for schema, least in ((grips.under(condition), 0.8), (grips, 0.7)):
            missed, std, _ = judged(schema, values, "tool_tip_position")
            assert (np.abs(missed) <= NINETY * std).mean() > least, condition


def test_certainty_is_saved_and_a_model_without_it_says_what_it_can(schema, arm, tmp_path):
    save(schema, tmp_path)
    values = row(arm.sample(1, 8), 0)
    values["joint_position"][1] = 2.4
    again = estimate(load(tmp_path), hidden(values, "muscle_length"))["muscle_length"]
    before = estimate(schema, hidden(values, "muscle_length"))["muscle_length"]
    np.testing.assert_array_equal(again.std, before.std)
    assert (again.state, again.reason) == (before.state, before.reason)
    head = json.loads((tmp_path / "manifest.json").read_text())
    del head["certainty"]
    (tmp_path / "manifest.json").write_text(json.dumps(checkpoint.signed(head)))
    old = load(tmp_path)
    assert old.certainty is None
    older = estimate(old, hidden(values, "muscle_length"))["muscle_length"]
    np.testing.assert_array_equal(older.std, old.errors["mask", older.mask][old.out_layout.slice("muscle_length")])
    assert older.state == "unknown" and "outside of the range of joint_position.elbow" in older.reason


@pytest.mark.parametrize(("name", "value"), [("slopes", -1e6), ("limits", 1e300), ("logs", 0.0), ("growth", -1.0)])
def test_a_model_that_would_be_sure_of_everything_is_refused(schema, tmp_path, name, value):
    arrays = schema.certainty.arrays()
    arrays[name] = np.full_like(arrays[name], value)
    forged = schema.with_certainty(Certainty.of(schema.certainty.ways, arrays))
    with pytest.raises(SchemaError, match=f"certainty.{name} holds a number that no training gives"):
        save(forged, tmp_path)
        load(tmp_path)


def test_an_estimate_with_its_interval_is_cheap(schema, arm):
    """At most three times as slow as without, with room for a busy machine."""
    values = hidden(row(arm.sample(1, 8), 0), "joint_position")
    plain = schema.with_certainty(None)

    def duration(body):
        times = []
        for _ in range(9):
            begin = time.process_time()
            for _ in range(300):
                estimate(body, values)
            times.append(time.process_time() - begin)
        return min(times)

    assert duration(schema) < 3.0 * duration(plain)


def test_the_factor_is_one_where_errors_have_one_size_and_grows_where_they_grow():
    random = np.random.default_rng(0)
    z = random.normal(size=(20_000, 2)).clip(-2.0, 2.5)
    even = fitted(np.abs(0.1 * random.normal(size=len(z))), z, 0.1)
    np.testing.assert_allclose(even, 0.0, atol=0.03)
    uneven = fitted(np.abs(0.1 * np.exp(0.5 * z[:, 0]) * random.normal(size=len(z))), z, 0.1)
    np.testing.assert_allclose(uneven, [0.0, 0.5, 0.0], atol=0.03)


def test_a_region_knows_its_edges_and_its_holes(schema, arm):
    region = Region(schema, "joint_position")
    states = [region.judge(theta).state for theta in arm.sample(300, 12)["joint_position"]]
    assert states.count("unknown") <= 6
    outside = region.judge(np.array([0.0, 2.0]))
    assert outside.reason.startswith("outside of the range of joint_position.elbow: 2 rad, learned to 1.")
    learned = arm.sample(3000, 13)["joint_position"]
    ring = np.linalg.norm((learned - (LOW + HIGH) / 2) / (HIGH - LOW), axis=1) > 0.25
    x = (learned[ring] - schema.scaler.mean[:2]) / schema.scaler.std[:2]
    hollow = replace(schema, anchors=np.concatenate([x, np.zeros((len(x), 10))], axis=1).astype(np.float32)[:1000])
    assert (
        Region(hollow, "joint_position").judge((LOW + HIGH) / 2).reason
        == "this joint_position is far from all learned ones"
    )


def test_a_region_is_not_measured_by_the_samples_right_before_and_after():
    """An arm of six joints moves between random postures; others of the same range were unknown, and control crept."""

    def motion(seed):
        postures = np.random.default_rng(seed).uniform(-1.7, 1.7, (100, 6))
        return np.concatenate([np.linspace(a, b, 20)[:-1] for a, b in pairwise(postures)])

    zeros, ones = np.zeros(6), np.ones(6)
    arm = SimpleNamespace(
        layout=Layout((Signal("joint_position", 6, "rad"),)), scaler=Scaler(zeros, ones, -1.8 * ones, 1.8 * ones),
        certainty=None, anchors=np.random.default_rng(0).permutation(motion(1))[:1000],
    )  # fmt: skip
    region = Region(arm, "joint_position")
    states = [region.judge(posture).state for posture in motion(2)[::5]]
    assert states.count("unknown") < 0.02 * len(states)
    corner = np.full(6, 1.75)
    assert region.judge(corner).reason == "this joint_position is far from all learned ones"


def test_growth_is_interpolated_and_rises_with_the_square_behind_its_end():
    knots, growth = np.array([1.0, 2.0, 4.0]), np.array([[0.1], [0.4], [1.0]])
    prediction = [grown(knots, growth, 0, distance) for distance in (0.5, 1.0, 3.0, 4.0, 8.0)]
    np.testing.assert_allclose(prediction, [0.05, 0.1, 0.7, 1.0, 4.0])


def test_a_model_from_a_file_and_an_updated_one_need_no_other_compiled_code(schema, arm, tmp_path):
    save(schema, tmp_path)
    values = row(arm.sample(1, 8), 0)
    updater = Updater(load(tmp_path))
    updater.add(values)
    updater.step(0)
    before = len(spread.signatures), len(novelties.signatures)
    for body in (schema, load(tmp_path), updater.schema):
        estimate(body, hidden(values, "joint_position"))
        estimate(body, {"muscle_length": values["muscle_length"]})
    assert (len(spread.signatures), len(novelties.signatures)) == before == (1, 1)
