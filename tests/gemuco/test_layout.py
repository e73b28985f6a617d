import numpy as np
import pytest
from muscle_arm import LAYOUT

from gemuco.errors import NotEnoughData, UnknownSignal, WrongSize
from gemuco.masks import all_masks, best, bits, covered_by, label, mask
from gemuco.scaler import Scaler
from gemuco.signals import Layout, Signal

A, B = frozenset({"joint_position"}), frozenset({"joint_position", "muscle_tension"})


def test_join_and_split_are_inverse():
    values = {"joint_position": np.arange(2.0), "muscle_tension": np.arange(5.0), "muscle_length": -np.arange(5.0)}
    joined = LAYOUT.join(values)
    assert joined.shape == (12,)
    for name, part in LAYOUT.split(joined).items():
        np.testing.assert_array_equal(part, values[name])
    rows = LAYOUT.join({name: np.stack([value, value]) for name, value in values.items()})
    np.testing.assert_array_equal(rows, [joined, joined])


def test_absent_signals_are_nan():
    joined = LAYOUT.join({"joint_position": np.zeros(2)})
    assert np.isfinite(joined[:2]).all()
    assert np.isnan(joined[2:]).all()


def test_names_elements_by_signal():
    assert LAYOUT.element(0) == "joint_position.shoulder"
    assert LAYOUT.element(11) == "muscle_length.both"


@pytest.mark.parametrize(
    ("values", "kind", "text"),
    [
        (
            {"joint_torque": np.zeros(2)},
            UnknownSignal,
            "Signal 'joint_torque' is not in the schema. Known signals: joint_position, muscle_tension, muscle_length.",
        ),
        (
            {"joint_position": np.zeros(3)},
            WrongSize,
            "Signal 'joint_position' has 2 elements, but the array has shape (3,).",
        ),
        (
            {"joint_position": ["one", "two"]},
            WrongSize,
            "Signal 'joint_position' needs 2 numbers, not a list.",
        ),
    ],
)
def test_says_what_is_wrong(values, kind, text):
    with pytest.raises(kind) as caught:
        LAYOUT.join(values)
    assert str(caught.value) == text


def test_refuses_two_signals_of_one_name():
    with pytest.raises(UnknownSignal, match="twice"):
        Layout((Signal("a", 1, "m"), Signal("a", 2, "m")))


def test_masks_are_sets():
    names = LAYOUT.names
    assert len(all_masks(names)) == 7
    assert bits(B, names).tolist() == [1.0, 1.0, 0.0]
    assert label(B, names) == "joint_position+muscle_tension"
    assert covered_by([A, B], {"joint_position", "muscle_length"}) == (A,)
    assert best([A, B], names, error=len) == A
    assert best([A, B], {"muscle_length"}, error=len) is None
    with pytest.raises(UnknownSignal, match="Mask names 'x'"):
        mask(["x"], names)


def test_scaler_does_not_blow_up_an_element_that_hardly_moved():
    random = np.random.default_rng(0)
    rows = random.standard_normal((500, 12)) * np.r_[1.0, 1e-9, np.ones(10)]
    scaler = Scaler.fit(LAYOUT, rows)
    assert scaler.std[1] == pytest.approx(0.02 * scaler.std[0])
    np.testing.assert_allclose(scaler.restore(scaler.normalise(rows)), rows, atol=1e-12)


def test_scaler_takes_an_element_that_was_never_measured_as_dead():
    rows = np.random.default_rng(0).normal(size=(5, 12))
    rows[:, 3] = np.nan
    scaler = Scaler.fit(LAYOUT, rows)
    assert scaler.dead.tolist() == [3]
    assert np.isfinite(scaler.std).all()
    with pytest.raises(NotEnoughData, match="no measured value at all"):
        Scaler.fit(LAYOUT, np.full((5, 12), np.nan))
