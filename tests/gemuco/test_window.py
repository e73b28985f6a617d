import numpy as np

from gemuco.adaption.window import Window


def filled(count, size=100, held_out=5, judges=3):
    window = Window(size, 1, held_out, judges)
    for value in range(count):
        window.add(np.array([value]))
    return window


def numbers(rows):
    return sorted(rows[:, 0].astype(int).tolist())


def test_only_the_newest_are_held_out_and_the_others_are_learned():
    window = filled(40)
    assert numbers(window.held()) == [29, 34, 39]
    assert numbers(window.learned()) == [i for i in range(40) if i not in (29, 34, 39)]


def test_a_sample_never_judges_after_it_was_learned():
    window, learned = filled(0), set()
    for value in range(120):
        window.add(np.array([value]))
        assert not learned & set(numbers(window.held()))
        learned |= set(numbers(window.learned()))


def test_a_full_window_keeps_the_newest_in_order():
    window = filled(25, size=10)
    assert window.rows()[:, 0].tolist() == list(range(15, 25))
    assert (len(window), window.dropped) == (10, 15)
    window.forget_before(22)
    assert window.rows()[:, 0].tolist() == [22, 23, 24]


def test_nothing_is_held_out_if_all_are_learned_from():
    window = filled(12, held_out=0)
    assert len(window.held()) == 0
    assert len(window.learned()) == 12
