import copy

import numpy as np
import pytest
from tool_arm import MASKS, ToolArm, dataset, tools

from gemuco.adaption import recognise as bias
from gemuco.adaption.config import UpdateConfig
from gemuco.adaption.innovation import Innovations
from gemuco.adaption.recognise import GaussNewton, Kalman, Prior
from gemuco.adaption.update import Updater
from gemuco.errors import SchemaError
from gemuco.layers import run
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.schema import BodySchema

TOOLS = tools((0.2, 0.35, 0.5), (0.0, 0.8), (0.8,))
SHORT, BENT, LONG = "0.2/0.0/0.8", "0.35/0.8/0.8", "0.5/0.0/0.8"
NEW = ToolArm(0.4, 0.4, 0.8)
THETA = frozenset({"joint_position"})


@pytest.fixture(scope="module")
def grips() -> BodySchema:
    config = TrainConfig(hidden=(50, 25), latent=8, bias_size=2, epochs=100, batch=100, rate=5e-3)
    return fit(dataset(TOOLS, 300), config, MASKS)[0]


def tip_error(schema: BodySchema, arm: ToolArm) -> float:
    """Mean distance [m] of the tool's tip from where it is predicted from the joints."""
    values = arm.sample(200, 999)
    span = schema.out_layout.slice("tool_tip_position")
    wrong = (
        schema.infer(schema.normalise(values), THETA)[:, span] - schema.normalise(values)[:, schema.out_index][:, span]
    )
    return float(np.linalg.norm(wrong * schema.scaler.std[schema.out_index][span], axis=1).mean())


def live(updater: Updater, arm: ToolArm, count: int, seed: int = 0, hide: tuple[str, ...] = ()) -> list:
    values = arm.walk(count, seed)
    results = []
    for index in range(count):
        updater.add({name: array[index] for name, array in values.items() if name not in hide})
        results.append(updater.step())
    return results


def test_derivatives_by_bias_are_finite_differences(grips):
    exact = grips.with_weights(grips.weights.astype(np.float64))
    innovations = Innovations(exact)
    row = exact.normalise({name: array[0] for name, array in NEW.sample(1, 3).items()})
    pairs = innovations.pairs(np.isfinite(row))
    assert len(pairs.masks) == 3  # the fourth has every signal and foretells none
    assert len(pairs.index) == 3 + 2 + 1  # only what the mask does not contain
    p = grips.bias.astype(float)
    error, slope = innovations.of(exact, pairs, row[None], p[None])
    for j in range(2):
        step = np.zeros(2)
        step[j] = 2.0**-10
        beyond, _ = innovations.of(exact, pairs, row[None], (p + step)[None])
        before, _ = innovations.of(exact, pairs, row[None], (p - step)[None])
        np.testing.assert_allclose((before - beyond)[0] / 2.0**-9, slope[0, :, j], rtol=2e-3, atol=2e-2)
    assert error.dtype == slope.dtype == np.float64


def test_the_network_is_good_enough_to_judge(grips):
    assert all(tip_error(grips.under(condition), arm) < 0.03 for condition, arm in TOOLS.items())  # m


@pytest.mark.parametrize("method", ["ekf", "gauss_newton"])
@pytest.mark.parametrize("condition", [BENT, SHORT])
def test_a_known_tool_is_recognised_in_one_sample(grips, method, condition):
    updater = Updater(grips.under(LONG), UpdateConfig(what="bias", bias_method=method))
    assert tip_error(updater.schema, TOOLS[condition]) > 0.1  # m
    live(updater, TOOLS[condition], 1)
    assert tip_error(updater.schema, TOOLS[condition]) < 0.04


def test_a_tool_never_seen_is_recognised_too(grips):
    updater = Updater(grips.under(LONG), UpdateConfig(what="bias"))
    results = live(updater, NEW, 15)
    assert tip_error(updater.schema, NEW) < 0.03
    assert results[-1].settled
    assert np.all(results[-1].bias_std < 0.2)


def test_a_later_change_is_followed_at_once_and_told(grips):
    updater = Updater(grips.under(LONG), UpdateConfig(what="bias"))
    first = live(updater, TOOLS[SHORT], 30)
    assert not any(result.changed for result in first[1:])
    second = live(updater, TOOLS[BENT], 3, seed=1)
    assert second[0].changed
    assert second[0].window == 1
    assert tip_error(updater.schema, TOOLS[BENT]) < 0.04


def test_weak_information_adds_up(grips):
    updater = Updater(grips.under(LONG), UpdateConfig(what="bias"))
    results = live(updater, TOOLS[SHORT], 35, hide=("tool_tip_position",))
    prior = Prior.of(grips)
    away = [prior.between(result.bias, grips.biases[SHORT]) for result in results]
    assert away[-1] < 0.3
    assert np.isfinite(results[0].bias).all()


def test_one_odd_sample_moves_nothing_for_long(grips):
    kalman = Kalman(grips.under(LONG))
    rows = grips.normalise(TOOLS[LONG].walk(21, 4))
    for row in rows[:15]:
        kalman.see(grips, row)
    odd = rows[15].copy()
    odd[grips.layout.slice("tool_tip_position")] += 8.0
    kalman.see(grips, odd)
    for row in rows[16:]:
        found = kalman.see(grips, row)
    assert Prior.of(grips).between(found.bias, grips.biases[LONG]) < 0.3


def test_nothing_is_learned_from_a_sample_that_tells_nothing(grips):
    for recogniser in (Kalman(grips.under(LONG)), GaussNewton(grips.under(LONG))):
        row = np.full(grips.layout.size, np.nan)
        row[:3] = 0.0
        found = recogniser.see(grips, row)
        assert np.isfinite(found.bias).all()
        assert not found.is_settled or isinstance(recogniser, Kalman)


def test_gradient_descent_is_the_slow_way(grips):
    config = UpdateConfig(what="bias", bias_method="gradient", steps=10, minimum=1, replay=0, held_out=0)
    updater = Updater(grips.under(LONG), config)
    arm = TOOLS[BENT]
    live(updater, arm, 1)
    assert tip_error(updater.schema, arm) > 0.05
    results = live(updater, arm, 40, seed=1)
    assert tip_error(updater.schema, arm) < 0.05
    assert np.array_equal(updater.schema.weights.encoder[0].matrix, grips.weights.encoder[0].matrix)
    assert np.isnan(results[-1].bias_std).all()


@pytest.mark.slow
def test_p_first_then_w_and_the_others_are_kept(grips):
    bent = ToolArm(0.35, 0.8, 0.8, bend=0.05)
    slow = Updater(grips.under(LONG), UpdateConfig(steps=5, rate=3e-4))
    fast = Updater(grips.under(LONG), UpdateConfig(what="weights", optimiser="sgd", rate=0.01, replay=0, held_out=0))
    bias = Updater(grips.under(LONG), UpdateConfig(what="bias"))
    for updater in (slow, fast, bias):
        live(updater, bent, 120)
    assert tip_error(slow.schema, bent) < tip_error(bias.schema, bent)
    others = [c for c in TOOLS if c != BENT]
    kept = np.mean([tip_error(slow.schema.under(c), TOOLS[c]) for c in others])
    lost = np.mean([tip_error(fast.schema.under(c), TOOLS[c]) for c in others])
    assert kept < 0.03  # m
    assert lost > 2.0 * kept


@pytest.mark.long
def test_both_at_once(grips):
    updater = Updater(grips.under(LONG), UpdateConfig(what="both", minimum=1))
    live(updater, NEW, 40)
    assert not np.array_equal(updater.schema.bias, grips.biases[LONG])
    assert not np.array_equal(updater.schema.weights.encoder[0].matrix, grips.weights.encoder[0].matrix)


@pytest.mark.long
def test_w_goes_back_when_it_does_harm(grips):
    """With a step that is far too large, an update that is checked and taken back ends nearer than one that is not."""
    shares = []
    for seed in range(5):
        wrong = {}
        for held_out in (UpdateConfig().held_out, 0):
            config = UpdateConfig("weights", optimiser="sgd", rate=0.5, replay=0, minimum=5, held_out=held_out)
            updater = Updater(grips.under(LONG), config)
            results = live(updater, TOOLS[LONG], 60, seed)
            assert results[-1].rolled_back > 0 or not held_out
            wrong[held_out] = tip_error(updater.schema, TOOLS[LONG])
        assert np.isfinite(list(wrong.values())).all()
        shares.append(wrong[UpdateConfig().held_out] / wrong[0])
    assert max(shares) < 1.0
    assert np.median(shares) < 0.5


@pytest.mark.long
def test_constraints_count_as_samples(grips):
    arm = TOOLS["0.2/0.8/0.8"]
    known = {name: array for name, array in arm.sample(50, 8).items() if name != "center_of_gravity"}
    config = UpdateConfig(what="weights", replay=0, minimum=1, rate=1e-3, held_out=0)
    bound, free = Updater(grips.under(LONG), config, constraints=known), Updater(grips.under(LONG), config)
    for updater in (bound, free):
        live(updater, TOOLS[LONG], 30)
    assert tip_error(bound.schema, arm) < tip_error(free.schema, arm)


def test_says_what_is_wrong(grips):
    with pytest.raises(SchemaError, match=r"what 'p' is not known\. Known: weights, bias, both, bias_then_weights"):
        UpdateConfig(what="p")
    with pytest.raises(SchemaError, match="bias_method 'newton' is not known"):
        UpdateConfig(bias_method="newton")
    with pytest.raises(SchemaError, match="leaves none to learn from"):
        UpdateConfig(held_out=1)


def test_what_was_predicted_is_what_the_network_says(grips):
    row = grips.normalise({name: array[0] for name, array in NEW.sample(1, 3).items()})
    innovations = Innovations(grips)
    pairs = innovations.pairs(np.isfinite(row))
    error, _ = innovations.of(grips, pairs, row[None], grips.bias[None])
    plain = np.linalg.solve(pairs.whiten, error[0])
    expected = row[grips.out_index] - run(grips.weights.whole, grips.network_input(row, pairs.masks[0]))
    inside = pairs.index[pairs.index < len(grips.out_index)]
    np.testing.assert_allclose(plain[: len(inside)], expected[inside], atol=1e-5)


def plain_begin_anew(kalman, prior):
    """Mean, covariance, weight and age of all beliefs after the body may have changed, in numpy."""
    count, known = kalman._count, kalman._known
    mean, covariance, log_weight, age = (array[:count].copy() for array in kalman._beliefs)
    weight = np.exp(log_weight)
    stays, comes = weight * (1.0 - bias.HAZARD), np.zeros(count)
    comes[:known] = bias.HAZARD * bias.FAMILIAR * weight.sum() / known
    unknown = bias.HAZARD * (1.0 - bias.FAMILIAR) * weight.sum()
    covariance[known:] += bias.DRIFT**2 * prior.covariance
    return (
        np.concatenate([mean, prior.mean[None]]),
        np.concatenate([covariance, prior.covariance[None]]),
        np.log(np.append(stays + comes, unknown)),
        np.append((stays * (age + 1) + comes) / (stays + comes), 1.0),
    )


def plain_thin(beliefs, known):
    """Of two filters whose ages differ least in proportion the less likely goes, until there are few enough."""
    mean, covariance, weight, age = beliefs
    while len(weight) > known + bias.BANK:
        order = known + np.argsort(age[known:])
        closest = int(np.argmin(age[order][1:] / age[order][:-1]))
        one, other = order[closest], order[closest + 1]
        gone = one if weight[one] < weight[other] else other
        mean, covariance, weight, age = (np.delete(array, gone, axis=0) for array in (mean, covariance, weight, age))
    return mean, covariance, weight, age


def plain_see(kalman, schema, row):
    """`Kalman.see` in numpy, as it is derived: the oracle of the compiled one."""
    pairs = kalman._innovations.pairs(np.isfinite(row))
    means, covariances, weights, ages = plain_begin_anew(kalman, kalman.prior)
    rows, at, scale = np.repeat(row[None], len(means), axis=0), means.copy(), kalman._scale
    known, count = kalman._known, len(pairs.index)
    before = np.linalg.inv(covariances)
    for turn in range(bias.PASSES):
        error, slope = kalman._innovations.of(schema, pairs, rows, at.astype(np.float32))
        if turn == 0:
            nearest = int(np.argmin((error[:-1] ** 2).sum(axis=1)))
            at[-1], error[-1], slope[-1] = at[nearest], error[nearest], slope[nearest]
        error = error - np.einsum("hnk,hk->hn", slope, means - at)
        gained, pull = np.einsum("hnj,hnk->hjk", slope, slope), np.einsum("hnk,hn->hk", slope, error)
        step = np.linalg.solve(before + gained / scale, pull[..., None] / scale)[..., 0]
        at = means + step
        at[:known] = means[:known]
    odd = np.maximum((error**2).sum(axis=1) / scale - (pull * step).sum(axis=1) / scale, 0.0)
    volume = pairs.log_volume + count * np.log(scale) + np.linalg.slogdet(covariances)[1]
    volume = volume + np.linalg.slogdet(before + gained / scale)[1]
    weight = weights - 0.5 * volume - 0.5 * (bias.FREEDOM + count) * np.log1p(odd / bias.FREEDOM)
    trust = np.minimum((bias.FREEDOM + count) / (bias.FREEDOM + odd), 1.0)
    after = np.linalg.inv(before + gained * (trust / scale)[:, None, None])
    mean, covariance = means.copy(), covariances.copy()
    mean[known:] += np.einsum("hjk,hk->hj", after, pull * (trust / scale)[:, None])[known:]
    covariance[known:] = after[known:]
    return plain_thin((mean, covariance, np.maximum(weight - weight.max(), bias.FAINTEST), ages), known)


@pytest.mark.parametrize("near", [0.0, bias.NEAR])
def test_the_compiled_bank_is_the_derived_one(grips, near):
    """Where all is linearised twice; and nearly so where what hardly moves, or is near another, is not."""
    schema = grips.under(LONG)
    compiled, tight = Kalman(schema), near == 0.0
    compiled._near = compiled._near * (near / bias.NEAR)
    walk = TOOLS[BENT].walk(15, 3)
    spread = np.sqrt(np.diag(compiled.prior.covariance))
    for index in range(15):
        row = schema.normalise_one({name: array[index] for name, array in walk.items()})
        mean, covariance, weight, age = plain_see(copy.deepcopy(compiled), schema, row)
        compiled.see(schema, row)
        found = [array[: compiled._count] for array in compiled._beliefs]
        assert compiled._count == len(mean) <= compiled._known + bias.BANK
        assert np.abs((found[0] - mean) / spread).max() < (1e-3 if tight else 0.05)
        if tight:
            np.testing.assert_allclose(found[1], covariance, rtol=1e-3, atol=1e-6)
            np.testing.assert_allclose(found[2], weight, atol=0.02)
            np.testing.assert_allclose(found[3], age, rtol=1e-9)


def test_what_is_believed_is_the_mean_over_all_beliefs(grips):
    kalman = Kalman(grips.under(LONG))
    for row in grips.normalise(NEW.walk(8, 6)):
        found = kalman.see(grips, row)
        mean, covariance, weight, age = (array[: kalman._count] for array in kalman._beliefs)
        share = np.exp(weight) / np.exp(weight).sum()
        away = mean - share @ mean
        spread = np.einsum("h,hjk->jk", share, covariance) + np.einsum("h,hj,hk->jk", share, away, away)
        np.testing.assert_allclose(found.bias, share @ mean, rtol=1e-9)
        np.testing.assert_allclose(found.covariance, spread, rtol=1e-9, atol=1e-15)
        assert found.since == round(age[np.argmax(weight)])
        whiten = np.linalg.inv(np.linalg.cholesky(kalman.prior.covariance))
        largest = np.sqrt(np.linalg.eigvalsh(whiten @ spread @ whiten.T)[-1])
        assert found.is_settled == (largest < bias.SETTLED)


def test_beliefs_that_share_a_linearisation_find_the_same(grips):
    """On walks with one tool and then another: as far as the bank that linearises every belief by itself."""
    shared, alone = (Kalman(grips.under(LONG)) for _ in range(2))
    alone._near = np.zeros_like(alone._near)
    rows = np.concatenate([grips.normalise(arm.walk(25, seed)) for seed, arm in enumerate((NEW, TOOLS[SHORT], NEW))])
    for row in rows:
        one, other = shared.see(grips, row), alone.see(grips, row)
        assert Prior.of(grips).between(one.bias, other.bias) < 0.02
        assert abs(one.since - other.since) <= 1


def test_errors_follow_a_body_of_which_only_p_is_updated(grips):
    """The tool bends the joints as no trained one did: p alone cannot explain it, and the errors say so."""
    strange = ToolArm(0.4, 0.4, 0.8, bend=0.15)
    updater = Updater(grips.under(LONG), UpdateConfig(what="bias"))
    values = strange.sample(60, 5)
    for index in range(60):
        updater.add({name: array[index] for name, array in values.items()})
        updater.step()
    span = grips.out_layout.slice("tool_tip_position")
    claimed = float(np.linalg.norm(updater.schema.errors["mask", THETA][span]))
    assert tip_error(updater.schema, strange) > 0.03  # m
    assert claimed == pytest.approx(tip_error(updater.schema, strange), rel=0.5)
