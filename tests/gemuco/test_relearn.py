from dataclasses import replace

import numpy as np
import pytest

from gemuco.adaption.gradient import gates, mean_error
from gemuco.anomaly.score import score
from gemuco.compiled.batch import under_masks
from gemuco.estimation import estimate


@pytest.fixture
def rows(schema, arm):
    """Samples of the arm [standard deviations], some of which lack something."""
    found = schema.normalise(arm.sample(40, 3)).astype(np.float32)
    found[np.random.default_rng(0).random(found.shape) < 0.05] = np.nan
    return found


def by_numpy(schema, rows, biases):
    """Inputs, wanted outputs and samples, mask after mask."""
    for mask in schema.masks:
        allowed = np.flatnonzero(np.isfinite(rows[:, schema.layout.indices(mask)]).all(axis=1))
        yield schema.network_input(rows[allowed], mask, biases[allowed]), rows[allowed][:, schema.out_index], allowed


def test_every_sample_is_learned_once_under_every_mask_that_it_allows(schema, rows):
    biases = np.random.default_rng(1).standard_normal((len(rows), len(schema.bias))).astype(np.float32)
    schema = replace(schema, shares={})  # else the targets are without the linear path: test_blend.py
    inputs, targets, weights, origin = under_masks(rows, biases, *gates(schema), schema.predictor)
    assert (weights == 1.0).all()
    found = inputs, targets, origin
    (inputs, *others), (expected, *rest) = found, map(np.concatenate, zip(*by_numpy(schema, rows, biases), strict=True))
    for ours, theirs in zip(others, rest, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    size = len(schema.in_index)
    code = np.arange(size, size + schema.path.width)  # its sums are rounded in another order
    np.testing.assert_array_equal(np.delete(inputs, code, axis=1), np.delete(expected, code, axis=1))
    np.testing.assert_allclose(inputs[:, code], expected[:, code], rtol=1e-4, atol=1e-6)
    assert schema.path.width


def test_the_mean_error_is_that_of_numpy(schema, rows):
    biases = np.repeat(schema.bias[None], len(rows), axis=0)
    wrong = np.concatenate([
        np.where(schema.gate(mask).direct[-1] > 0.0, schema.infer(rows[allowed], mask) - wanted, np.nan)
        for mask, (_, wanted, allowed) in zip(schema.masks, by_numpy(schema, rows, biases), strict=True)
    ])  # fmt: skip
    assert mean_error(schema, rows) == pytest.approx(np.nanmean(wrong**2), rel=1e-5)


def test_what_the_last_schema_was_asked_is_ready_in_the_next(schema, arm, monkeypatch):
    row = {name: array[0] for name, array in arm.sample(1, 5).items()}
    row["joint_position"][0] = np.nan
    estimate(schema, row)
    score(schema, row)
    after = schema.with_weights(schema.weights)
    after.prepare(schema)
    for module, name in (("estimation", "Recipe"), ("anomaly.prediction", "Judgement")):
        monkeypatch.delattr(f"gemuco.{module}.{name}.of")  # nothing is worked out any more
    assert estimate(after, row)["joint_position"].method == "mask"
    assert score(after, row).score == pytest.approx(score(schema, row).score)
