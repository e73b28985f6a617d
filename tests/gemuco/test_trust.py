"""Lies of sensors: found, named, hidden, and trusted again; and a healthy body is left alone."""

from dataclasses import replace

import numpy as np
import pytest

from gemuco.anomaly.healthy import learn_normal
from gemuco.anomaly.prediction import judging_masks
from gemuco.dataset import as_dataset
from gemuco.intervals.region import learned_range
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.normal.watch import Watch
from gemuco.trust.cases import Case
from gemuco.trust.changes import LONGEST
from gemuco.trust.config import BLOCK, TrustConfig
from gemuco.trust.evidence import Evidence
from gemuco.trust.hypotheses import Cause, Signs, explain
from gemuco.trust.monitor import TrustMonitor
from gemuco.trust.relations import Relations, rows_of
from gemuco.trust.sensitivity import Sensitivity

SAMPLES = 5
"""Samples in a block."""
JOINT, TENSION, LENGTH = 0, 3, 8
NOISE = np.r_[np.full(2, 0.002), np.full(5, 0.3), np.full(5, 2e-4)]


def move(arm, blocks, seed):
    """Return samples of a smooth motion that rests now and then, shape (blocks, SAMPLES, 12)."""
    random, count = np.random.default_rng(seed), blocks * SAMPLES
    pace = np.repeat(random.random(blocks // 10 + 1) > 0.2, 10 * SAMPLES)[:count]
    phase = random.uniform(0, 6.0, 7) + np.cumsum(pace)[:, None] * random.uniform(0.01, 0.03, 7)
    theta = np.array([0.0, 0.9]) + 0.6 * np.sin(phase[:, :2])
    tension = 50.0 + 40.0 * np.sin(phase[:, 2:])
    whole = np.concatenate([theta, tension, arm.length(theta, tension)], axis=1)
    return (whole + random.normal(0.0, 1.0, whole.shape) * NOISE).reshape(blocks, SAMPLES, 12)


@pytest.fixture(scope="module")
def model(data, arm):
    masks = [("joint_position", "muscle_tension"), ("muscle_tension", "muscle_length")]
    schema = fit(data, TrainConfig(hidden=(60, 20), latent=7, epochs=30, batch=100), masks)[0]
    rows = np.concatenate([move(arm, 600, 100 + seed)[:, 0] for seed in range(8)])
    return schema.with_normal(learn_normal(schema, rows))


def watch(model, samples, monitor=None, config=None):
    """Judge all blocks; return the monitor, and the hidden elements after every block."""
    monitor = monitor or TrustMonitor(model, config)
    hidden = []
    for index, block in enumerate(model.scaler.normalise(samples)):
        monitor.add(block, index * BLOCK)
        hidden.append(monitor.hidden)
    return monitor, hidden


def test_derivatives_are_those_of_the_errors_also_after_an_update_chose_other_masks(model, arm):
    columns, normal = Relations.of(model).columns, model.normal
    assert np.isnan(normal.mean).any(), "those of the tension, which the watch predicts better"
    every = replace(normal, mean=np.nan_to_num(normal.mean), covariance=np.eye(len(normal.covariance)))
    sensitivity = Sensitivity(model.with_normal(every), columns)
    x = model.scaler.normalise(move(arm, 8, 1)[:, 0])
    chosen = judging_masks(model)["muscle_tension"]
    errors = {way: 100.0 * error if way[1] == chosen else error for way, error in model.errors.items()}
    updated = model.with_weights(model.weights, errors)
    assert judging_masks(updated)["muscle_tension"] != chosen
    for schema in (model, updated, model):
        (before, slopes), step = sensitivity.errors(schema, rows_of(schema, x)), 0.01
        assert slopes.any(axis=(0, 1)).all()
        for element in range(12):
            moved = x.copy()
            moved[:, element] += step
            change = sensitivity.errors(schema, rows_of(schema, moved))[0] - before
            assert np.allclose(change / step, slopes[:, :, element], atol=0.05)


def test_a_relation_is_the_prediction_of_the_watch(model, arm):
    """With and without a hidden element the errors are those of `Watch.reading`."""
    relations, normal = Relations.of(model), model.normal
    rows = rows_of(model, model.scaler.normalise(move(arm, 40, 1)[:, 0]))
    features = relations.features(rows)
    alone = features @ relations.without(frozenset()).maps
    assert np.allclose(alone, normal.watch.reading(None).residuals(rows)[:, :12], atol=1e-6)
    rows[:, JOINT] = np.nan
    partly = relations.features(rows) @ relations.without(frozenset({JOINT})).maps
    assert np.allclose(
        np.delete(partly, JOINT, axis=1), normal.watch.reading(np.isfinite(rows[0])).residuals(rows)[:, :11], atol=1e-6
    )
    assert isinstance(normal.watch, Watch)


@pytest.mark.parametrize("off", [0.3, 1.0, 3.0])
def test_how_wrong_a_hidden_element_is_changes_nothing_of_the_others(model, arm, off):
    relations = Relations.of(model)
    rows = rows_of(model, model.scaler.normalise(move(arm, 20, 1)[:, 0]))
    sees_network = False
    for element in range(12):
        hidden, others = frozenset({element}), np.arange(12) != element

        def errors(wrong, hidden=hidden, element=element):
            own = rows.copy()
            own[:, element] += wrong
            values, sensed = own[:, relations.columns], relations.sensitivity.sense(model, own)
            judged = relations.judged(model, hidden, relations.features(own), sensed, values)
            return judged.errors / judged.healthy

        sees_network |= bool(relations.without(hidden).network[others].any())
        assert np.abs(errors(off) - errors(0.0))[:, others].max() < 0.5
        assert (errors(off) - errors(0.0))[:, element].min() > 2.0
    assert sees_network


@pytest.mark.long
def test_a_healthy_body_is_trusted(model, arm):
    for seed in range(2):
        monitor, hidden = watch(model, move(arm, 600, seed))
        assert not any(hidden)
        assert not monitor.findings


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("offset", ("offset",)),
        ("frozen", ("frozen", "clipped")),
        ("sign", ("sign", "gain", "offset")),
        ("noise", ("noise",)),
        ("wrap", ("wrap",)),
    ],
)
def test_a_lying_encoder_is_hidden_and_returns(model, arm, kind, names):
    """The lie lasts for 8 s; the encoder alone is hidden within 2 s of a visible error, and used again after it."""
    samples, begin, end = move(arm, 400, 7), 150, 230
    true, wrong, span = samples[..., JOINT].copy(), samples[..., JOINT], slice(begin, end)
    random = np.random.default_rng(3)
    wrong[span] = {
        "offset": true[span] + 0.3,
        "frozen": np.full((end - begin, SAMPLES), true[begin, 0]),
        "sign": -true[span],
        "noise": true[span] + 0.1 * random.normal(size=(end - begin, SAMPLES)),
        "wrap": true[span] + 2.0 * np.pi,
    }[kind]
    visible = begin + int(np.argmax(np.abs(wrong - true)[span].mean(axis=1) > 0.1 if kind != "noise" else True))
    monitor = TrustMonitor(model)
    _, hidden = watch(model, samples[: visible + 20], monitor)
    assert not any(hidden[:begin])
    assert hidden[-1] == {JOINT}
    (finding,) = monitor.findings
    assert finding.is_distrusted and finding.elements == (JOINT,)
    kinds = []
    for index, block in enumerate(model.scaler.normalise(samples[visible + 20 :])):
        monitor.add(block, (visible + 20 + index) * BLOCK)
        assert monitor.hidden == {JOINT} or index + visible + 20 > end
        kinds += [finding.kind for finding in monitor.findings]
    assert kinds[-1] in names
    assert not monitor.hidden


def resting(arm, model, seed, blocks):
    """Return samples of 30 s of motion and of `blocks` blocks at rest after it, and the monitor after 35 s."""
    samples, random = move(arm, 300 + blocks, seed), np.random.default_rng(seed)
    samples[300:] = samples[300, 0] + random.normal(0.0, 1.0, samples[300:].shape) * NOISE
    monitor, hidden = watch(model, samples[:350])
    assert not any(hidden)
    return samples[350:], monitor


@pytest.mark.parametrize(
    "element", [JOINT, *(pytest.param(element, marks=pytest.mark.long) for element in (TENSION, LENGTH))]
)
@pytest.mark.parametrize("rate", [0.3, pytest.param(1.0, marks=pytest.mark.long)])
def test_a_slow_drift_at_rest_is_hidden_and_an_end_of_it_is_seen(model, arm, element, rate):
    """At rest the errors of one posture do not change; a drift of 0.3 healthy errors per second was never found."""
    samples, monitor = resting(arm, model, 51, 450)
    column = list(monitor._bench.relations.columns).index(element)
    healthy = (monitor._bench.view.healthy[-1] * monitor._bench.judge.scale)[column] * model.scaler.std[element]
    found = 200
    samples[:200, :, element] += healthy * rate * BLOCK * np.arange(200)[:, None]
    for index, block in enumerate(model.scaler.normalise(samples)):
        monitor.add(block, 35.0 + index * BLOCK)
        if element in monitor.hidden:
            found = min(found, index)
    assert 2.0 < found * BLOCK * rate < 6.5
    assert not monitor.hidden


@pytest.mark.long
def test_a_body_at_rest_is_trusted_also_if_it_creeps(model, arm):
    samples = move(arm, 600, 61)
    moving = samples[290:590].reshape(-1, 12).T
    slow, random = np.linspace(0.0, 12.0, moving.shape[1]), np.random.default_rng(1)
    creeping = np.stack([np.interp(slow, np.arange(len(slow)), column) for column in moving], 1)
    samples[300:] = creeping.reshape(300, SAMPLES, 12) + random.normal(0.0, 1.0, samples[300:].shape) * NOISE
    monitor, hidden = watch(model, samples)
    assert monitor._bench.recent.resting > 10
    assert not any(hidden)


@pytest.mark.long
def test_an_encoder_whose_lie_ends_at_rest_is_used_again(model, arm):
    """It lied when the body settled, so its return to the truth is no change to accuse it of."""
    samples, random = move(arm, 500, 71), np.random.default_rng(71)
    samples[300:] = samples[300, 0] + random.normal(0.0, 1.0, samples[300:].shape) * NOISE
    samples[150:400, :, JOINT] += 0.3
    _, hidden = watch(model, samples)
    assert hidden[399] == {JOINT}
    assert not any(hidden[440:])


def coarse(blocks, seed):
    """Return samples of two angles and two torques, of which the second stays within half a step of its sensor."""
    random, count = np.random.default_rng(seed), blocks * SAMPLES
    angle = np.sin(random.uniform(0, 6.0, 2) + np.arange(count)[:, None] * random.uniform(0.01, 0.03, 2))
    torque = np.stack([4.0 * angle[:, 0] + angle[:, 1], 0.0045 * angle[:, 1]], axis=1)
    angle = angle + random.normal(0.0, 0.002, angle.shape)
    return {"angle": angle, "torque": torque + np.c_[random.normal(0.0, 0.02, count), np.zeros(count)]}


def test_an_element_that_hardly_varies_does_not_lie_by_a_step_of_its_sensor():
    """The torque of a wrist, simulated without a bus for the training, is one count or none on the bus."""
    schema = fit(
        as_dataset(coarse(600, 1), {"angle": "rad", "torque": "N m"}),
        TrainConfig(hidden=(20,), latent=3, epochs=20),
        [("angle",)],
    )[0]

    def on_the_bus(blocks, seed, away):
        values = coarse(blocks, seed)
        values["torque"][:, 1] = 0.01 * np.round((values["torque"][:, 1] + away) / 0.01)
        return schema.layout.join(values)

    schema = schema.with_normal(learn_normal(schema, on_the_bus(600, 2, 0.0)))
    steps = on_the_bus(300, 3, 0.003)
    assert len(np.unique(steps[:, 3])) == 2
    _, hidden = watch(schema, steps.reshape(300, SAMPLES, 4))
    assert not any(hidden)


def test_elements_that_look_alike_are_both_named(model, arm):
    """A length and a tension of one muscle contradict each other; nothing else knows which is right."""
    samples = move(arm, 260, 11)
    samples[150:, :, LENGTH] += 0.01
    _, hidden = watch(model, samples)
    assert LENGTH in hidden[-1]
    assert hidden[-1] <= {LENGTH, TENSION}
    used, _ = watch(model, samples, config=TrustConfig(pairs="use"))
    if len(hidden[-1]) > 1:
        assert not used.hidden
        assert "alike" in used.findings[0].reason


@pytest.mark.parametrize(
    "pair", [(0, 1), *(pytest.param(pair, marks=pytest.mark.long) for pair in ((2, 4), (7, 8), (9, 11)))]
)
def test_two_swapped_elements_are_both_hidden_until_they_are_put_back(model, arm, pair):
    """Two that are wrong would not agree with all others in each other's place.

    Tensions are predicted worse: 3 and 5 are not found in every motion.
    """
    samples, swapped = move(arm, 320, 41), slice(150, 240)
    samples[swapped, :, pair] = samples[swapped, :, pair[::-1]]
    monitor, hidden = watch(model, samples[:240])
    assert hidden[-1] == set(pair)
    assert [(finding.kind, finding.cause) for finding in monitor.findings] == [("swapped", "all")]
    _, hidden = watch(model, samples[240:], monitor)
    assert not hidden[-1]


def test_a_part_that_was_hidden_returns_when_it_agrees_and_the_next_one_needs_more_evidence(model, arm):
    samples = move(arm, 240, 31)
    monitor, _ = watch(model, samples[:150])
    assert monitor._bench.healthy.caution == 0.0
    part = Cause(frozenset({TENSION, LENGTH}), "part", LENGTH)
    monitor._cases.append(Case(part, 150, 150, 150, steps=np.zeros(12), is_hidden=True))
    _, hidden = watch(model, samples[150:], monitor)
    assert hidden[0] == {TENSION, LENGTH}
    assert not hidden[-1]
    assert monitor._bench.healthy.caution > 1.0, "it agreed again by itself, and was perhaps right"


def test_while_a_muscle_may_have_changed_other_sensors_are_accused_later(model, arm):
    """The wire may be cut, which makes sensors of its neighbours look wrong. Those that lie beside a joint are not."""
    samples = move(arm, 170, 31)
    samples[100:, :, TENSION] += 30.0
    samples[150:, :, JOINT] += 0.1
    monitor, hidden = watch(model, samples)
    assert hidden[149] == hidden[-1] == {TENSION}
    assert any(finding.elements == (JOINT,) and finding.reason for finding in monitor.findings)
    samples = move(arm, 170, 31)
    samples[100:, :, JOINT] += 0.3
    samples[150:, :, TENSION] += 15.0
    _, hidden = watch(model, samples)
    assert (hidden[149], hidden[-1]) == ({JOINT}, {JOINT, TENSION})


@pytest.mark.parametrize(
    ("element", "other"),
    [(8, 10), *(pytest.param(*pair, marks=pytest.mark.long) for pair in ((0, 1), (1, 0), (10, 8), (11, 7)))],
)
def test_an_element_that_reads_another_is_not_taken_for_two_swapped(model, arm, element, other):
    samples = move(arm, 240, 41)
    samples[150:, :, element] = samples[150:, :, other]
    monitor, hidden = watch(model, samples)
    assert element in hidden[-1]
    assert all(finding.kind != "swapped" for finding in monitor.findings)


@pytest.mark.parametrize(("beyond", "accused"), [((), JOINT), ((TENSION,), TENSION), ((LENGTH,), JOINT)])
def test_what_is_outside_of_the_learned_range_contradicts_no_other(beyond, accused):
    """The wire of a muscle is cut: joint and tension explain it alone, the joint better, and the length does not."""
    strength = np.zeros(12)
    strength[[JOINT, TENSION, LENGTH]] = 98.0, 37.0, 42.0
    ratio = np.where(strength > 0.0, 0.6, 0.0)
    ratio[JOINT] = 1.0
    whole = Evidence(ratio, strength, np.full(12, 5), np.zeros(12), np.zeros(12, bool), np.zeros(12, bool), 1.0)

    def without(columns):
        return whole if columns.isdisjoint({JOINT, TENSION}) else replace(whole, ratio=0.3 * ratio)

    cause = explain(whole, without, (), (), frozenset(), Signs(beyond=frozenset(beyond)))
    assert (cause.cause, cause.columns) == ("element", frozenset({accused}))


def test_the_learned_range_is_that_of_the_training_or_of_normal_samples_beyond_it(model, arm):
    x = model.scaler.normalise(move(arm, 40, 1)[:, 0])
    low, high = learned_range(model)
    assert ((low < x) & (x < high)).all()
    assert (low[TENSION], high[TENSION]) == pytest.approx(
        (model.certainty.low[TENSION] - 0.03 * np.ptp([model.certainty.low, model.certainty.high], axis=0)[TENSION],
         model.certainty.high[TENSION] + 0.03 * np.ptp([model.certainty.low, model.certainty.high], axis=0)[TENSION])
    )  # fmt: skip
    rows = model.normal.rows.copy()
    rows[0, TENSION], rows[1, TENSION] = high[TENSION] + 1.0, np.nan
    wider = learned_range(model.with_normal(replace(model.normal, rows=rows)))
    assert wider[1][TENSION] == pytest.approx(high[TENSION] + 1.0), "the body itself was there, and was normal"
    assert np.array_equal(wider[0], low)


@pytest.mark.long
def test_at_rest_the_noise_of_the_sensors_is_no_motion(model, arm):
    """The same error at one posture says the same again and again, for minutes."""
    samples = np.concatenate([move(arm, 200, 15), np.zeros((900, SAMPLES, 12))])
    samples[200:] = samples[199, -1] + np.random.default_rng(16).normal(0.0, 1.0, (900, SAMPLES, 12)) * NOISE
    samples[200:, :, JOINT] += 0.015
    _, hidden = watch(model, samples)
    assert not any(hidden)


@pytest.mark.long
def test_a_small_offset_is_noticed_by_its_jump_and_hidden_until_it_jumps_back(model, arm):
    samples = move(arm, 420, 18)
    samples[200:300, :, TENSION] += 6.0
    _, hidden = watch(model, samples)
    wrong = [index for index, elements in enumerate(hidden) if elements == {TENSION}]
    assert 200 <= wrong[0] < 210
    assert 300 <= wrong[-1] < 300 + LONGEST
    assert len(wrong) == wrong[-1] - wrong[0] + 1


def test_never_more_than_the_model_can_replace(model, arm):
    samples = move(arm, 200, 13)
    samples[150:, :, JOINT] += 0.5
    monitor = TrustMonitor(model, replaces=lambda elements: False)
    watch(model, samples, monitor)
    assert not monitor.hidden
    assert monitor.findings[0].reason == "the model cannot replace it"


def test_an_operator_decides(model, arm):
    samples = move(arm, 300, 14)
    samples[150:, :, JOINT] += 0.5
    monitor = TrustMonitor(model)
    monitor.distrust(1, 0.0)
    _, hidden = watch(model, samples[:200], monitor)
    assert hidden[-1] == {0, 1}
    monitor.trust(0)
    monitor.trust(1)
    _, hidden = watch(model, samples[200:], monitor)
    assert not any(hidden)


def test_a_wrong_body_distrusts_no_sensor(model, arm):
    """All lengths change: no element explains that, and nothing is hidden for it."""
    samples = move(arm, 260, 15)
    samples[150:, :, 7:] *= 1.0 + np.array([0.03, -0.04, 0.05, -0.03, 0.04])
    monitor, causes = TrustMonitor(model), set()
    for index, block in enumerate(model.scaler.normalise(samples)):
        monitor.add(block, index * BLOCK)
        causes |= {finding.cause for finding in monitor.findings}
    assert len(monitor.hidden) <= 1
    assert "body" in causes


def test_a_model_without_normal_errors_judges_nothing(model, arm):
    monitor = TrustMonitor(model.with_normal(None))
    monitor.add(model.scaler.normalise(move(arm, 1, 0)[0]), 0.0)
    assert not monitor.is_ready
