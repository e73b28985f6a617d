import numpy as np
import pytest

from gemuco.structure.mask_search import _scenes, choose, find_border


def lines(*masks: str) -> np.ndarray:
    return np.array([[bit == "1" for bit in mask] for mask in masks])


def contains(masks: np.ndarray, parts: np.ndarray) -> np.ndarray:
    return np.array([any((part <= mask).all() for part in parts) for mask in masks])


@pytest.mark.parametrize("seed", range(3))
def test_the_border_of_a_monotone_rule_is_found_whole(seed):
    parts = lines("110000000000", "001110000000", "000001111000", "100000000011")
    border = find_border(lambda masks: contains(masks, parts), 12, 4000, seed)
    assert border.is_complete
    assert {m.tobytes() for m in border.smallest} == {m.tobytes() for m in parts}
    assert not contains(border.largest, parts).any()
    assert border.tried < 2048


def test_exceptions_beside_the_border_are_found():
    parts, exception = lines("1110000000"), lines("0111111110")
    rule = lambda masks: contains(masks, parts) | (masks == exception).all(axis=1)  # noqa: E731
    border = find_border(rule, 10, 4000)
    assert {m.tobytes() for m in border.smallest} == {m.tobytes() for m in np.concatenate([parts, exception])}


def test_the_search_stops_at_its_budget():
    random = np.random.default_rng(0)
    border = find_border(lambda masks: random.random(len(masks)) < 0.5, 16, 500)
    assert not border.is_complete
    assert border.tried < 2500


def test_the_chosen_masks_serve_whatever_is_available():
    candidates = lines("1100", "0011", "1110", "1101", "0111", "1011")
    outputs = np.ones(4, bool)
    errors = np.where(candidates, 0.0, 0.1)
    chosen = candidates[choose(candidates, errors, outputs, 3)]
    assert {m.tobytes() for m in candidates[:2]} <= {m.tobytes() for m in chosen}
    assert len(choose(candidates, errors, outputs, 6)) == 6
    assert len(chosen) <= 3


@pytest.mark.parametrize("seed", range(8))
def test_each_mask_that_is_picked_gains_most(seed):
    random = np.random.default_rng(seed)
    candidates = np.unique(random.random((150, 8)) < 0.6, axis=0)
    errors, outputs = random.uniform(0.0, 0.3, candidates.shape), random.random(8) < 0.8
    picked = choose(candidates, errors, outputs, 20, seed)
    scenes = _scenes(8, seed)
    needed = outputs & ~scenes
    scenes, needed = scenes[needed.any(axis=1)], needed[needed.any(axis=1)]
    cost = (needed @ errors.T) / needed.sum(axis=1, keepdims=True)
    cost[(~scenes).astype(int) @ candidates.T.astype(int) > 0] = 1.0
    inside = (~candidates).astype(int) @ candidates.T.astype(int) == 0  # [i, j]: i contains j
    first = np.flatnonzero(inside.sum(axis=1) == 1)
    first = first if len(first) <= 20 else first[:0]
    np.testing.assert_array_equal(picked[: len(first)], first)
    assert len(picked) == 20
    for count in range(len(first), 20):
        least = cost[:, picked[:count]].min(axis=1, initial=1.0)
        gains = np.maximum(least[:, None] - cost, 0.0).sum(axis=0)
        assert gains[picked[count]] == pytest.approx(gains.max(), rel=1e-4)
