"""What CUDA does, on torch's device `cpu`: it must say what compiled code says."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from muscle_arm import LAYOUT, MuscleArm

from gemuco.dataset import Dataset, Episode
from gemuco.layers import ACTIVATIONS
from gemuco.learning import cores, devices
from gemuco.learning.train import Job, TrainConfig, fine_tune, fit, fit_all
from gemuco.masks import all_masks, bits
from gemuco.structure.determination import Judge, Thresholds, determine
from gemuco.structure.mask_training import train_masks

MASKS = (frozenset({"joint_position", "muscle_tension"}), frozenset({"muscle_tension", "muscle_length"}))
CONFIG = TrainConfig(hidden=(30, 20), latent=6, epochs=8, batch=100, bias_size=2, patience=99)


@pytest.fixture(scope="module")
def bodies() -> Dataset:
    """Two conditions; gaps, and what stands out so far that it is rejected."""
    random = np.random.default_rng(0)
    arms = {"new": MuscleArm(), "worn": MuscleArm(softness=2.0)}
    parts = [Episode(name, arm.sample(110, seed)) for name, arm in arms.items() for seed in range(5)]
    for part in parts:
        part.values["muscle_length"][random.random(110) < 0.05] = np.nan
        part.values["muscle_tension"][7, 2] = 900.0
    return Dataset(LAYOUT, tuple(parts))


def on(device, monkeypatch, work):
    with monkeypatch.context() as patched:
        patched.setattr(devices, "best", lambda: device)
        return work()


def like(one, other):
    """Rounding differs, and a training amplifies it."""
    for (schema, history), (same, told) in zip(one, other, strict=True):
        np.testing.assert_allclose(history.train, told.train, rtol=2e-3)
        np.testing.assert_allclose(history.held_out, told.held_out, rtol=2e-3)
        for name, p in schema.biases.items():
            np.testing.assert_allclose(p, same.biases[name], atol=5e-3)
        for a, b in zip(schema.weights.arrays(), same.weights.arrays(), strict=True):
            np.testing.assert_allclose(a, b, atol=2e-2)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_stack_of_trainings_is_what_they_are_one_by_one(bodies, activation, monkeypatch):
    shapes = [{}, {"seed": 1}, {"seed": 2, "epochs": 5}, {"seed": 3, "hidden": (20,)}, {"outliers": float("inf")}]
    jobs = [Job(bodies, replace(CONFIG, activation=activation, **shape), MASKS) for shape in shapes]
    jobs.append(Job(Dataset(LAYOUT, bodies.episodes[2:9]), CONFIG, MASKS))  # fewer samples, so fewer batches
    told = []
    alone = on(None, monkeypatch, lambda: [fit(job.dataset, job.config, job.masks) for job in jobs])
    stacked = on("cpu", monkeypatch, lambda: fit_all(jobs, lambda done, _: told.append(done)))
    like(stacked, alone)
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert [len(history.train) for _, history in stacked] == [8, 8, 5, 8, 8, 8]


def test_trainings_side_by_side_are_what_they_are_one_by_one(bodies, monkeypatch):
    jobs = [Job(bodies, replace(CONFIG, seed=seed, epochs=4 + seed), MASKS) for seed in range(3)]
    monkeypatch.setattr(cores, "count", lambda: 3)
    told = []
    together = on(None, monkeypatch, lambda: fit_all(jobs, lambda done, _: told.append(done)))
    for job, (schema, history) in zip(jobs, together, strict=True):
        alone, course = fit(job.dataset, job.config, job.masks)
        assert history.held_out == course.held_out
        for a, b in zip(schema.weights.arrays(), alone.weights.arrays(), strict=True):
            np.testing.assert_array_equal(a, b)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_whoever_is_told_of_trainings_side_by_side_may_end_them(bodies, monkeypatch):
    monkeypatch.setattr(cores, "count", lambda: 2)
    jobs = [Job(bodies, replace(CONFIG, seed=seed, epochs=100_000, patience=100_000), MASKS) for seed in range(2)]

    def enough(done, text):
        raise InterruptedError

    with pytest.raises(InterruptedError):
        on(None, monkeypatch, lambda: fit_all(jobs, enough))


def test_masks_on_several_cores_have_the_same_errors(bodies, monkeypatch):
    (errors,) = train_masks(bodies, replace(CONFIG, epochs=2))
    masks = np.array([bits(m, LAYOUT.names) > 0 for m in all_masks(LAYOUT.names)])
    found, judge = [], Judge(LAYOUT.names, (errors,), Thresholds(1.0, 0.02))
    for count in (1, 2, 5):
        monkeypatch.setattr(cores, "count", lambda count=count: count)
        judged = judge.race(masks)
        assert judged.is_rough.any()
        judge.finish(judged, np.arange(0, len(masks), 2))
        found.append((errors.of(masks), *astuple(judged)))
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_without_bias_and_with_one_condition(data, monkeypatch):
    jobs = [Job(data, replace(CONFIG, bias_size=size), MASKS) for size in (0, 1)]
    alone = on(None, monkeypatch, lambda: fit_all(jobs))
    like(on("cpu", monkeypatch, lambda: fit_all(jobs)), alone)


def test_each_member_stops_when_it_is_to(bodies, monkeypatch):
    jobs = [Job(bodies, replace(CONFIG, rate=rate, bias_rate=rate, patience=2), MASKS) for rate in (0.0, 1e-2)]
    found = [
        [len(history.train) for _, history in on(device, monkeypatch, lambda: fit_all(jobs))]
        for device in ("cpu", None)
    ]
    assert found[0] == found[1]
    assert found[0][0] < found[0][1] == 8


def test_fine_tuning(bodies, monkeypatch):
    before, _ = fit(bodies, CONFIG, MASKS)
    few = Dataset(LAYOUT, tuple(Episode("bent", MuscleArm(softness=1.5).sample(60, seed)) for seed in range(4)))
    config = replace(CONFIG, rate=1e-3, bias_rate=1e-3)
    found = [on(device, monkeypatch, lambda: fine_tune(before, few, config)) for device in ("cpu", None)]
    like(found[:1], found[1:])


def test_goes_on_after_an_interruption_with_and_without(bodies, tmp_path, monkeypatch):
    class Stopped(Exception):
        pass

    def stop(done, _text):
        if done >= 0.5:
            raise Stopped

    jobs = [Job(bodies, replace(CONFIG, seed=seed), MASKS, resume=tmp_path / f"{seed}") for seed in (0, 1)]
    with pytest.raises(Stopped):
        on("cpu", monkeypatch, lambda: fit_all(jobs, stop))
    found = on(None, monkeypatch, lambda: fit_all(jobs))
    assert [history.resumed for _, history in found] == [3, 3]
    like(found, on(None, monkeypatch, lambda: [fit(job.dataset, job.config, job.masks) for job in jobs]))


def test_errors_of_masks(bodies, monkeypatch):
    errors = train_masks(bodies, CONFIG, 2)
    masks = np.array([bits(m, LAYOUT.names) > 0 for m in all_masks(LAYOUT.names)])
    judge = Judge(LAYOUT.names, errors, Thresholds(1.0, 0.5))
    want = judge.of(masks)
    monkeypatch.setattr("gemuco.learning.batched.TOGETHER", 500)  # in several goes
    found = on("cpu", monkeypatch, lambda: judge.race(masks))
    np.testing.assert_allclose(found.L_m, want.L_m, rtol=1e-3)
    np.testing.assert_allclose(found.squared, want.squared, rtol=1e-3)
    assert not found.is_rough.any()


def test_a_structure_of_several_splits(data, monkeypatch):
    config = TrainConfig(hidden=(30,), latent=6, epochs=15, batch=100)
    thresholds = Thresholds(0.9, 0.3)
    one, other = (
        on(device, monkeypatch, lambda: determine(data, config, thresholds, splits=3)) for device in ("cpu", None)
    )
    assert one.L_i == pytest.approx(other.L_i, rel=0.02)
    assert one.L_m == pytest.approx(other.L_m, rel=0.02)
    assert one.x_out == other.x_out
