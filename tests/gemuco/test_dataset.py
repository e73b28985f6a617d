import numpy as np
import pytest
from muscle_arm import LAYOUT

from gemuco.dataset import Dataset, Episode
from gemuco.errors import DatasetError, NotEnoughData


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


def test_splits_few_episodes_by_time_block(arm):
    values = arm.sample(100, 0)
    train, held = Dataset(LAYOUT, (Episode("new", values),)).split(0.2)
    assert (len(train), len(held)) == (80, 20)
    rows = LAYOUT.join(values)
    first = int(np.flatnonzero((rows == held.rows()[0]).all(axis=1))[0])
    np.testing.assert_array_equal(held.rows()[:10], rows[first : first + 10])


def test_too_little_to_split():
    with pytest.raises(NotEnoughData, match="collect more"):
        Dataset(LAYOUT, ()).split(0.2)
