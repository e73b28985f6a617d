"""Intervals that are widened by the errors that are seen."""

from collections import deque

import numpy as np
import pytest

from gemuco.certainty.certainty import NINETY
from gemuco.intervals.widening import FIRST, LEAST, MEMORY, NARROWEST, RecentErrors, Widening


def covered(errors: np.ndarray, late: int) -> np.ndarray:
    """Whether each error, shape (n,), is within its interval of std 1 times the factor; truth comes `late`."""
    widening, pending, inside = Widening(1), deque(), []
    for error in errors:
        std = widening.factor.copy()
        inside.append(abs(error) <= NINETY * std[0])
        pending.append((np.array([error]), std))
        if len(pending) > late:
            widening.see(*pending.popleft(), late)
    return np.array(inside)


def shares(inside: np.ndarray) -> np.ndarray:
    """Share of hits in every window of 300."""
    return np.convolve(inside, np.ones(300) / 300, "valid")


def drifting(seed: int, count: int = 3000) -> np.ndarray:
    """Errors that remember their past for ten samples, and become three times as large in the middle."""
    random, errors = np.random.default_rng(seed), np.zeros(count)
    for index in range(1, count):
        errors[index] = 0.9 * errors[index - 1] + 0.436 * random.standard_normal()
    return errors * np.where(np.arange(count) < count // 2, 1.0, 3.0)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("late", "least", "most"), [(0, 0.87, 0.93), (10, 0.85, 0.95)])
def test_ninety_of_a_hundred_in_every_window_whatever_the_errors_are(seed, late, least, most):
    share = shares(covered(drifting(seed), late))
    assert least <= share.min() and share.max() <= most
    constant = shares(np.abs(drifting(seed)) <= NINETY)
    assert constant.min() < 0.6


def test_what_is_not_known_changes_nothing():
    widening = Widening(3)
    widening.see(np.array([np.nan, 5.0, 0.0]), np.array([1.0, np.nan, 1.0]))
    assert widening.factor[:2].tolist() == [1.0, 1.0]
    assert widening.factor[2] < 1.0
    assert widening.seen.tolist() == [0, 0, 1]


def test_factors_have_bounds_and_begin_anew():
    widening = Widening(2)
    for _ in range(500):
        widening.see(np.array([0.0, 1e9]), np.ones(2))
    assert widening.factor.tolist() == [LEAST, 1e3]
    widening.forget()
    assert widening.factor.tolist() == [1.0, 1.0]


def test_a_lost_signal_keeps_an_interval_that_held_before():
    random, recent = np.random.default_rng(0), RecentErrors(2)
    for scale in np.exp(0.5 * np.sin(0.05 * np.arange(600))):
        recent.see(5.0 * scale * random.standard_normal(2), np.array([1.0, np.nan]))
    assert recent.factor[1] == 1.0
    later = [5.0 * scale * random.standard_normal() for scale in np.exp(0.5 * np.sin(0.05 * np.arange(3000)))]
    assert 0.88 < np.mean(np.abs(later) <= NINETY * recent.factor[0]) < 0.97


def test_few_errors_count_little_and_old_ones_leave():
    recent = RecentErrors(1)
    recent.see(np.array([1e6]), np.ones(1))
    assert 1.0 <= recent.factor[0] < 2.0
    for _ in range(FIRST):
        recent.see(np.array([10.0]), np.ones(1))
    assert recent.factor[0] == pytest.approx(10.0 / NINETY)
    for _ in range(MEMORY):
        recent.see(np.array([1e-3]), np.ones(1))
    assert recent.factor[0] == NARROWEST
    kept = recent.factor
    recent.forget()
    assert recent.factor.tolist() == [1.0] and kept.tolist() == [NARROWEST]
