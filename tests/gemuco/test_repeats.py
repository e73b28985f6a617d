"""Repeated motions are found by their paths, and only those."""

from itertools import pairwise

import numpy as np
import pytest

from gemuco.dataset import Dataset, Episode
from gemuco.learning.config import TrainConfig
from gemuco.learning.train import fit
from gemuco.signals import Layout, Signal
from gemuco.splits.division import Division
from gemuco.splits.repeats import Piece, repeated

LAYOUT = Layout((Signal("position", 3, "rad"), Signal("load", 2, "N")))


def motion(seed: int, rows: int = 300, joints: int = 3, stroke: int = 30) -> np.ndarray:
    """Smooth strokes between random postures, shape (rows, joints)."""
    goals = np.random.default_rng(seed).uniform(-1.0, 1.0, (rows // stroke + 2, joints))
    share = np.linspace(0.0, 1.0, stroke, endpoint=False)[:, None]
    path = 10 * share**3 - 15 * share**4 + 6 * share**5
    return np.concatenate([a + (b - a) * path for a, b in pairwise(goals)])[:rows]


def slower(rows: np.ndarray, factor: float) -> np.ndarray:
    """The same path at another speed."""
    times = np.arange(0.0, len(rows) - 1, factor)
    return np.stack([np.interp(times, np.arange(len(rows)), column) for column in rows.T], axis=1)


def groups(labels: np.ndarray) -> set[frozenset[int]]:
    return {frozenset(np.flatnonzero(labels == label).tolist()) for label in np.unique(labels)}


def test_repetitions_are_grouped_with_noise_shift_and_another_speed():
    random, paths = np.random.default_rng(0), [motion(seed) for seed in range(3)]
    pieces = []
    for index, kind in enumerate([0, 1, 0, 2, 1, 0, 2]):
        part = slower(paths[kind], random.uniform(0.8, 1.25))[random.integers(0, 25) :]
        pieces.append(Piece(index, part + 0.03 * random.normal(size=part.shape)))
    assert groups(repeated(pieces)) == {frozenset({0, 2, 5}), frozenset({1, 4}), frozenset({3, 6})}


@pytest.mark.parametrize("joints", [2, 3, 6])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_different_motions_of_one_body_are_not_grouped(joints, seed):
    mixing = np.random.default_rng(seed).normal(size=(joints, 6))
    pieces = [Piece(i, np.tanh(motion(100 * seed + i, joints=joints) @ mixing)) for i in range(15)]
    assert len(groups(repeated(pieces))) == 15


def test_one_long_motion_is_not_grouped_with_its_own_neighbours():
    rows = motion(0, 3000)
    assert len(groups(repeated([Piece(0, part) for part in np.array_split(rows, 20)]))) == 20


@pytest.mark.long
def test_independent_samples_are_not_a_motion():
    random = np.random.default_rng(0)
    for count in (20, 250):
        assert len(groups(repeated([Piece(i, random.normal(size=(60, 3))) for i in range(count)]))) == count


def test_a_motion_of_one_joint_says_nothing():
    assert len(groups(repeated([Piece(i, motion(i, joints=1)) for i in range(8)]))) == 8


def test_too_short_to_be_a_motion():
    assert repeated([]).tolist() == []
    assert repeated([Piece(0, np.ones((2, 3))), Piece(1, np.ones((1, 3)))]).tolist() == [0, 1]


def test_gaps_do_not_hide_a_repetition():
    path = motion(0)
    holed = path.copy()
    holed[np.random.default_rng(0).random(holed.shape) < 0.1] = np.nan
    assert groups(repeated([Piece(0, path), Piece(1, holed), Piece(2, motion(1))])) == {
        frozenset({0, 1}),
        frozenset({2}),
    }


def episodes(*kinds: int) -> Dataset:
    """An episode per number; the same number is the same path of the position with other loads."""
    random = np.random.default_rng(0)
    parts = []
    for index, kind in enumerate(kinds):
        position = motion(kind) + 0.02 * random.normal(size=(300, 3))
        parts.append(Episode("arm", {"position": position, "load": motion(1000 + index, joints=2)}))
    return Dataset(LAYOUT, tuple(parts))


def test_a_split_keeps_repetitions_together():
    kinds = (0, 1, 0, 2, 3, 1, 0, 4)
    data = episodes(*kinds)
    firsts = [episode.values["load"][0, 0] for episode in data.episodes]
    ever = set()
    for seed in range(5):
        train, held = data.split(0.2, seed)
        sides = [{kinds[firsts.index(e.values["load"][0, 0])] for e in part.episodes} for part in (train, held)]
        assert not sides[0] & sides[1]
        ever |= sides[1]
        again = data.split(0.2, seed)[1]
        np.testing.assert_array_equal(again.rows(), held.rows())
    assert ever == {0, 1, 2, 3, 4}
    (note,) = data.repetitions()
    assert "its 8 episodes are 5 motions (3 and 2 episodes are nearly equal)" in note
    assert episodes(0, 1, 2, 3, 4, 5).repetitions() == ()
    config = TrainConfig(hidden=(5,), latent=2, epochs=1)
    assert note in fit(data, config, [{"position"}])[1].notes


def test_most_of_the_data_is_never_held_out():
    data = episodes(0, 0, 0, 0, 0, 1, 2)
    for seed in range(4):
        assert len(data.split(0.3, seed)[1].episodes) == 1
    assert "more than half of the data is always trained on" in data.repetitions()[0]


def test_a_command_that_is_always_the_same_is_named_and_joins_nothing():
    command = motion(7, joints=2)
    parts = [Episode("arm", {"position": motion(i), "load": command}) for i in range(6)]
    data = Dataset(LAYOUT, (*parts, parts[0]))
    assert "its 7 episodes are 6 motions" in data.repetitions()[0]
    assert "The path of load is the same everywhere" in data.repetitions()[0]


def test_a_recording_of_one_cycle_says_that_no_other_motion_was_held_out():
    phase = np.arange(3000)[:, None] / 150.0 * 2.0 * np.pi
    position = np.concatenate([np.sin(phase), np.cos(2.0 * phase + 0.3), np.sin(3.0 * phase + 1.0)], axis=1)
    load = np.concatenate([np.cos(phase), np.sin(phase) ** 2], axis=1)
    random = np.random.default_rng(0)
    noisy = {"position": position + 0.05 * random.normal(size=position.shape), "load": load}
    data = Dataset(LAYOUT, (Episode("arm", noisy),))
    (note,) = data.repetitions()
    assert "repeat one motion" in note
    train, held = data.split(0.2)
    assert len(held) > 0.1 * len(data)
    assert len(train) > 0.6 * len(data)


def test_small_data_get_shorter_blocks_and_slow_signals_longer_gaps():
    spans = {"position": slice(0, 3)}
    quick, slow = (Division.of([motion(0, 1500, stroke=stroke)], spans) for stroke in (8, 40))
    assert 20 <= len(slow.parts) < len(quick.parts) <= 40
    assert slow.gap > quick.gap > 0
    held = slow.held(0.2, 0)
    used = {row for part in slow.trained(held) for row in range(part.start, part.stop)}
    for index in held:
        part = slow.parts[index]
        assert used.isdisjoint(range(part.start - slow.gap, part.stop + slow.gap))
