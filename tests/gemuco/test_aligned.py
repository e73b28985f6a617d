"""Rows at the times of a late camera's frames, and rows of the other sensors alone when no frame comes."""

import numpy as np

from gemuco.trust.aligned import GAP, SLOW, WAIT, Aligned, Interpolated

SPEED = 2.0
LATE = 0.05
"""A frame arrives this long after it was taken [s]."""


def angle(time):
    """Of a joint that turns to and fro."""
    return 0.3 * np.sin(SPEED / 0.3 * time)


def play(frames, seconds=2.0, cycle=0.01):
    """Return all rows (joint, camera) of a joint that is read every cycle, and a camera with frames at these times."""
    aligned, rows, waiting = Aligned(), [], list(frames)
    for now in np.arange(0.0, seconds, cycle):
        aligned.add(now, np.array([angle(now), np.nan]))
        while waiting and waiting[0] + LATE <= now:
            taken = waiting.pop(0)
            aligned.see(taken, np.array([np.nan, angle(taken)]))
        rows += aligned.take(now)
    return np.array(rows)


def test_a_late_frame_stands_beside_the_angle_at_its_time():
    rows = play(np.arange(0.005, 2.0, 1 / 30))
    assert len(rows) >= 55
    assert np.isfinite(rows).all()
    assert np.abs(rows[:, 0] - rows[:, 1]).max() < 1e-3, "0.1 rad beside the newest angle"


def test_a_frame_that_fails_leaves_the_camera_out_and_the_others_in():
    rows = play(np.r_[np.arange(0.005, 0.5, 1 / 30), np.arange(1.505, 2.0, 1 / 30)])
    alone = np.isnan(rows[:, 1])
    assert np.isfinite(rows[:, 0]).all()
    assert 40 <= alone.sum() <= 60, "one second, but for the wait before and after"
    assert not alone[-5:].any()
    assert np.flatnonzero(alone)[0] >= 14


def test_without_a_camera_every_sample_passes_after_the_wait():
    rows = play([])
    assert len(rows) == round((2.0 - WAIT) / 0.01)
    assert np.isnan(rows[:, 1]).all()


def test_nothing_is_interpolated_over_a_gap_and_nothing_goes_back():
    aligned = Aligned()
    aligned.add(0.0, np.array([0.0, np.nan]))
    aligned.add(2.0 * GAP, np.array([1.0, np.nan]))
    aligned.add(GAP, np.array([9.0, np.nan]))  # older than the one before
    aligned.see(GAP, np.array([np.nan, 5.0]))
    assert aligned.take(2.0 * GAP) == []
    aligned.add(2.5 * GAP, np.array([2.0, np.nan]))
    aligned.see(2.25 * GAP, np.array([np.nan, 6.0]))
    np.testing.assert_allclose(aligned.take(2.5 * GAP), [[1.5, 6.0]])
    aligned.see(2.25 * GAP, np.array([np.nan, 7.0]))  # repeated
    aligned.see(2.1 * GAP, np.array([np.nan, 7.0]))
    assert aligned.take(2.5 * GAP) == []


def held(slow, seconds=4.0, cycle=0.01, ends=np.inf, delay=0.0):
    """Return times, rows (joint, slow) and delays of a joint that is read every cycle and one that is read slowly."""
    rows, at, taken = Interpolated(2), 0.0, []
    for now in np.arange(0.0, seconds, cycle):
        if now - delay >= at + slow - 1e-9 and now < ends:
            at = now - delay
        rows.add(now, np.array([angle(now), angle(at)]), np.array([now, at]))
        taken += [(time, *row, now - time) for time, row in rows.take(now)]
    return np.array(taken)


def test_a_slow_value_is_interpolated_to_the_time_of_the_others():
    taken = held(0.1)
    learned = taken[taken[:, 0] > 1.0]
    assert len(learned) >= 0.9 * 300
    assert np.abs(learned[:, 1] - learned[:, 2]).max() < 0.02, "0.2 rad beside a value that is held"
    assert learned[:, 3].max() <= 0.1 + 1e-9
    assert (np.diff(taken[:, 0]) > 0.0).all()


def test_a_value_that_arrives_late_is_interpolated_too():
    learned = held(0.08, delay=0.03)
    learned = learned[learned[:, 0] > 1.0]
    assert np.abs(learned[:, 1] - learned[:, 2]).max() < 0.02
    assert learned[:, 3].max() <= 0.12


def test_values_of_every_cycle_do_not_wait():
    taken = held(0.01)
    assert len(taken) == 400
    assert (taken[:, 3] == 0.0).all()
    np.testing.assert_array_equal(taken[:, 1], taken[:, 2])
    once = held(0.01, ends=3.97)  # three cycles without an answer make nothing slow
    assert (once[:, 3] == 0.0).all()
    assert SLOW > 0.02


def test_a_slow_value_that_falls_silent_is_missing_and_the_others_go_on():
    taken = held(0.1, ends=2.0)
    after = taken[taken[:, 0] > 2.1]
    assert len(after) >= 140
    assert np.isnan(after[:, 2]).all()
    assert np.isfinite(after[:, 1]).all()
    assert after[:, 3].max() <= WAIT + 0.015
