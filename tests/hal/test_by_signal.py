import numpy as np
import pytest

from hal.by_signal import KEPT, LONGEST, NOTHING, Elements, Numbers, Truths

COUNTS = {"joint_position": 2, "muscle_tension": 3}


def test_parts_lie_one_behind_the_other() -> None:
    values = Numbers(np.arange(5.0), Elements.of(COUNTS))
    assert list(values) == list(COUNTS)
    assert len(values) == 2
    assert "muscle_tension" in values
    assert values["muscle_tension"].tolist() == [2.0, 3.0, 4.0]
    values["joint_position"][0] = 7.0
    assert values.flat[0] == 7.0
    with pytest.raises(KeyError):
        values["elbow"]
    assert (values | {"elbow": np.ones(1)}).keys() == {*COUNTS, "elbow"}


def test_arrays_of_each_signal_are_joined_in_the_order_that_is_asked_for() -> None:
    parts = {"muscle_tension": [3, 4, 5], "joint_position": [1, 2]}
    assert Numbers.of(parts).flat.tolist() == [3.0, 4.0, 5.0, 1.0, 2.0]
    assert Numbers.of(parts, Elements.of(COUNTS)).flat.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    turned = Numbers.of(Numbers.of(parts), Elements.of(COUNTS))
    assert turned["joint_position"].tolist() == [1.0, 2.0]
    assert Truths.of({"joint_position": [1, 0]}).flat.dtype == bool
    assert Numbers.of({}).elements is NOTHING


@pytest.mark.parametrize("parts", [{}, {"joint_position": [1, 2]}, COUNTS | {"joint_position": [1, 2, 3]}])
def test_other_signals_are_refused(parts: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="these numbers of elements"):
        Numbers.of(parts, Elements.of(COUNTS))


@pytest.mark.parametrize("counts", [{"a": 0}, {"a": -1}, {"a": 1.5}, {"a": "2"}, {"a": [1]}, {"a": None}, {3: 1}])
def test_what_is_no_number_of_elements_is_refused(counts: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="number of elements, at least 1"):
        Elements.of(counts)


def test_equal_ones_are_the_same_object_and_memory_is_bounded() -> None:
    assert Elements.of(COUNTS) is Elements.of(dict(COUNTS))
    assert Elements.of(COUNTS) != Elements.of(dict(reversed(COUNTS.items())))
    before = Elements.of(COUNTS)
    for number in range(3 * KEPT):
        Elements.of({f"signal_{number}": 1})
    assert len(Elements._known) <= KEPT
    assert Elements.of(COUNTS) == before  # but for its place in memory
    for long in ({"a" * (LONGEST + 1): 1}, {f"signal_{number}": 1 for number in range(LONGEST)}):
        assert Elements.of(long).counts == long
        assert tuple(long.items()) not in Elements._known
