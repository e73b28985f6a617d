"""Values that are not quite of one time are no lie: their errors grow with the velocity, and how large is learned."""

import numpy as np
import pytest

from gemuco.anomaly.healthy import learn_normal
from gemuco.dataset import Dataset, Episode
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.signals import Layout, Signal
from gemuco.trust import aligned
from gemuco.trust.aligned import TIMING, Shift, changes
from gemuco.trust.config import BLOCK
from gemuco.trust.monitor import TrustMonitor
from gemuco.trust.relations import Relations, rows_of

LAYOUT = Layout((Signal("joint_position", 3, "rad"), Signal("tool_tip_position", 3, "m", ("x", "y", "z"))))
SAMPLES, NOISE, LATE = 5, 2e-4, 0.02
"""Samples in a block, noise of the tip [m], and the age of its values [s]."""
SLOW, FAST = 0.3, 3.0
"""Velocities of the joints [rad/s]."""


def tip_at(position):
    """Return the place of the tip [m] at joint positions [rad], shape (n, 3)."""
    pan, first, both = position[:, 0], position[:, 1], position[:, 1] + position[:, 2]
    reach = 0.2 + 0.3 * np.cos(first) + 0.3 * np.cos(both)
    return np.stack([reach * np.cos(pan), reach * np.sin(pan), 0.3 * np.sin(first) + 0.3 * np.sin(both)], axis=1)


def motion(seconds, speed, seed, late=0.0):
    """Return all elements while the joints go to random targets, shape (n, 6).

    Args:
        seconds: Length of the motion [s].
        speed: Velocity of the joints [rad/s]; of each second, again and again, if it is a list.
        seed: Seed of targets and noise.
        late: Age of the tip's values [s].
    """
    random, fine = np.random.default_rng(seed), 1000
    steps, now, goal = np.repeat(np.resize(speed, int(seconds)), fine) / fine, np.zeros(3), np.zeros(3)
    walked = np.zeros((len(steps), 3))
    for row, step in zip(walked, steps, strict=True):
        if np.array_equal(now, goal):
            goal = random.uniform(-1.0, 1.0, 3)
        now = np.where(np.abs(goal - now) <= step, goal, now + np.sign(goal - now) * step)
        row[:] = now
    taken = np.arange(fine // 10, len(walked), round(fine * BLOCK / SAMPLES))
    tip = tip_at(walked[taken - round(late * fine)])
    return np.concatenate([walked[taken], tip + NOISE * random.standard_normal(tip.shape)], axis=1)


@pytest.fixture(scope="module")
def model():
    position = np.random.default_rng(0).uniform(-1.0, 1.0, (2000, 3))
    rows = np.concatenate([position, tip_at(position) + NOISE * np.random.default_rng(1).standard_normal((2000, 3))], 1)
    episodes = [Episode("", LAYOUT.split(part)) for part in np.array_split(rows, 8)]
    schema = fit(Dataset(LAYOUT, tuple(episodes)), TrainConfig(epochs=60), (("joint_position",),))[0]
    return schema.with_normal(learn_normal(schema, motion(60.0, SLOW, 50)[::5]))


def watch(model, rows):
    """Judge all samples; return the monitor, and the names of all that was hidden."""
    monitor, names = TrustMonitor(model), set()
    whole = rows[: len(rows) // SAMPLES * SAMPLES]
    for number, block in enumerate(model.scaler.normalise(whole).reshape(-1, SAMPLES, LAYOUT.size)):
        monitor.add(block, number * BLOCK)
        names |= {LAYOUT.element(index) for index in monitor.hidden}
    return monitor, names


@pytest.mark.parametrize("seed", range(3))
def test_a_fast_motion_is_no_lie(model, seed):
    """The mean posture of a block is none of its postures, so what follows from it is wrong in a fast motion."""
    assert watch(model, motion(80.0, [SLOW] * 9 + [FAST], seed))[1] == set()


def test_right_sensors_are_rarely_hidden_beside_a_late_tip(model, monkeypatch):
    moves = [motion(60.0, [0.2, 0.5, 1.0, 0.3, 2.0], seed, 0.5 * LATE) for seed in range(4, 8)]
    assert sum(bool(watch(model, rows)[1]) for rows in moves) <= 1
    monkeypatch.setattr(aligned, "TIMING", 1e-9)
    assert sum(bool(watch(model, rows)[1]) for rows in moves) >= 3, "without it they are"


@pytest.mark.parametrize("late", [0.0, 0.25 * LATE, LATE])
def test_how_late_a_signal_is_is_learned(model, late):
    joint, tip = watch(model, motion(120.0, 1.0, 7, late))[0]._bench.healthy.lag * -TIMING
    assert tip - joint == pytest.approx(late, abs=0.1 * late + 0.001)
    assert tip >= 0.0 >= joint - 0.001, "the delay of all signals together is not known"


@pytest.mark.parametrize("seed", range(10, 12))
def test_a_late_signal_is_known_before_the_motion_becomes_fast(model, seed):
    assert watch(model, motion(50.0, [SLOW] * 40 + [7.0 * SLOW] * 10, seed, 0.3 * LATE))[1] == set()


def test_a_lie_is_found_beside_a_late_tip(model):
    rows = motion(60.0, 1.0, 8, LATE)
    rows[1500:, 1] += 0.3
    assert watch(model, rows)[1] == {"joint_position.1"}


def test_a_jump_is_no_velocity():
    signals, rows = np.array([0, 0, 1, -1]), np.zeros((6, 4))
    rows[:, 0] = np.arange(6) * 0.02  # one per second, at ten samples in each block
    rows[3:, 1] = 1.0
    rows[:, 2] = -np.arange(6) * 0.02
    rows[4, 2] = np.nan
    moved = changes(rows, signals)
    assert moved.shape == (2, 4)
    assert moved[0] == pytest.approx([TIMING, 0.0, 0.0, 0.0])
    assert moved[1, [0, 1, 3]] == pytest.approx(0.0)
    assert -TIMING <= moved[1, 2] < 0.0, "a missing sample makes it smaller"
    assert not changes(rows[:2], signals).any(), "of one step it is not known whether it is a jump"


def test_the_error_of_a_late_signal_is_that_of_its_shifted_values(model):
    relations = Relations.of(model)
    rows = rows_of(model, model.scaler.normalise(motion(2.0, 1.0, 9)[::10]))
    rows[:, 3:6] = np.random.default_rng(0).normal(rows[:, 3:6], 0.01)
    values, sensed = rows[:, relations.columns], relations.sensitivity.sense(model, rows)
    late = np.zeros((len(rows), 2, values.shape[1]))
    late[:, 1, 3:6] = 1e-3
    shifted = rows.copy()
    shifted[:, 3:6] += 1e-3
    change = relations.features(shifted) - relations.features(rows)
    shift = Shift(late, np.stack([np.zeros_like(change), change], axis=1))
    hidden = frozenset[int]()
    judged = relations.judged(model, hidden, relations.features(rows), sensed, values, shift)
    own = relations.judged(
        model, hidden, relations.features(shifted), relations.sensitivity.sense(model, shifted),
        shifted[:, relations.columns],
    )  # fmt: skip
    assert relations.without(hidden).network.any()
    assert judged.late[:, 1] == pytest.approx(own.errors - judged.errors, abs=1e-4)
    assert not judged.late[:, 0].any()
    still = relations.judged(model, hidden, relations.features(rows), sensed, values)
    assert not still.late.any()
    assert np.array_equal(still.errors, judged.errors)
