import numpy as np
import pytest
from muscle_arm import LAYOUT

from gemuco.dataset import Dataset, Episode
from gemuco.errors import DatasetError, NotEnoughData
from gemuco.signals import Layout, Signal


def test_comes_back_from_disk(data, tmp_path):
    data.save(tmp_path / "deep" / "data.npz")
    again = Dataset.load(tmp_path / "deep" / "data.npz")
    assert again.layout == data.layout
    assert again.conditions == ("new",)
    np.testing.assert_array_equal(again.rows(), data.rows())


@pytest.mark.parametrize("content", [b"", b"not a zip", None])
def test_says_what_is_wrong_with_a_file(tmp_path, content):
    path = tmp_path / "data.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DatasetError) as caught:
        Dataset.load(path)
    assert "data.npz" in str(caught.value)
    assert str(caught.value).count("\n") == 0


def test_a_cut_file_is_damaged(data, tmp_path):
    path = tmp_path / "data.npz"
    data.save(path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(DatasetError, match="not a readable dataset"):
        Dataset.load(path)


def test_splits_by_episode(data):
    train, held = data.split(0.25, seed=1)
    assert (len(train.episodes), len(held.episodes)) == (9, 3)
    whole = {episode.values["joint_position"][0, 0] for episode in held.episodes}
    assert whole.isdisjoint({episode.values["joint_position"][0, 0] for episode in train.episodes})


def test_splits_few_episodes_by_time_block_with_a_gap(arm):
    values = arm.sample(100, 0)
    data = Dataset(LAYOUT, (Episode("new", values),))
    rows = LAYOUT.join(values)

    def places(part):
        return {int(np.flatnonzero((rows == row).all(axis=1))[0]) for row in part.rows()}

    gone = 0
    for seed in range(5):
        train, held = map(places, data.split(0.2, seed))
        assert len(held) == 20
        assert not any(place + step in train for place in held for step in (-1, 0, 1))
        assert len(train) >= 72
        gone += 100 - len(train) - len(held)
    assert gone > 0


def test_successive_seeds_hold_out_everything_once(arm):
    data = Dataset(LAYOUT, (Episode("new", arm.sample(100, 0)),))
    held = np.concatenate([data.split(0.2, seed)[1].rows() for seed in range(5)])
    assert sorted(held[:, 0]) == sorted(data.rows()[:, 0])
    orders = [data.split(0.2, seed)[1].rows()[0, 0] for seed in range(10)]
    assert orders[:5] != orders[5:]


@pytest.mark.parametrize(("episodes", "size"), [(1, 60), (3, 40), (6, 20), (2, 1)])
def test_every_condition_is_on_both_sides(arm, episodes, size):
    names = ("light", "heavy", "none")
    parts = [Episode(name, arm.sample(size, i)) for i in range(episodes) for name in names]
    for seed in range(5):
        train, held = Dataset(LAYOUT, tuple(parts)).split(0.2, seed)
        assert set(train.conditions) == set(held.conditions) == set(names)
        assert 0.9 * 3 * episodes * size <= len(train) + len(held) <= 3 * episodes * size


def test_too_little_to_split(arm):
    with pytest.raises(NotEnoughData, match="record some with"):
        Dataset(LAYOUT, ()).split(0.2)
    parts = (Episode("light", arm.sample(50, 0)), Episode("heavy", arm.sample(1, 0)))
    with pytest.raises(NotEnoughData, match="Condition 'heavy' has 1 samples"):
        Dataset(LAYOUT, parts).split(0.2)


def test_infinite_is_not_measured(arm):
    values = arm.sample(20, 0)
    values["muscle_length"][3, 1] = np.inf
    data = Dataset(LAYOUT, (Episode("new", values),))
    assert np.isnan(data.rows()[3, LAYOUT.slice("muscle_length")][1])


def test_takes_the_signals_of_another_layout(data):
    swapped = Layout((LAYOUT.signal("muscle_length"), LAYOUT.signal("joint_position")))
    part = data.with_layout(swapped)
    np.testing.assert_array_equal(part.rows()[:, 5:], data.rows()[:, :2])
    np.testing.assert_array_equal(part.rows()[:, :5], data.rows()[:, 7:])


@pytest.mark.parametrize(
    ("signal", "text"),
    [
        (Signal("wire", 2, "m"), "Signal 'wire' is not in the data. Its signals: joint_position, muscle_tension"),
        (Signal("joint_position", 2, "deg", ("shoulder", "elbow")), "is in rad in the data, but must be in deg"),
        (Signal("joint_position", 2, "rad", ("elbow", "shoulder")), "has the elements shoulder, elbow in the data"),
        (Signal("joint_position", 3, "rad"), "has the elements shoulder, elbow in the data, but must have 0, 1, 2"),
    ],
)
def test_other_signals_are_a_sentence(data, signal, text):
    with pytest.raises(DatasetError) as caught:
        data.with_layout(Layout((signal,)))
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
