import numpy as np
import pytest

from gemuco.normal.windows import Windows


@pytest.mark.parametrize("seed", range(4))
def test_a_long_window_with_a_small_lasting_shift_is_not_normal(seed):
    """Errors without memory: the mean of 64 is known to an eighth of their std, so a shift of half a std is plain."""
    random = np.random.default_rng(seed)
    errors = random.normal(size=(3000, 5))
    windows = Windows.fit(np.linalg.norm(errors, axis=1), errors, 1e-3)
    fresh = random.normal(size=(200, 64, 5))
    assert not any(windows.shifted(window, 6.0) > 0.0 for window in fresh)
    assert np.mean([windows.shifted(window + 0.5, 6.0) > 0.0 for window in fresh]) > 0.9


def body(random, count):
    """Return samples of a body that wanders, and its errors: three depend on the posture, two are noise."""
    samples = random.normal(size=(count, 4))
    for i in range(1, count):
        samples[i] = 0.9 * samples[i - 1] + np.sqrt(1.0 - 0.9**2) * samples[i]
    return samples, errors_of(samples, random)


def errors_of(samples, random):
    return np.c_[np.sin(5.0 * samples[:, :3]), random.normal(size=(len(samples), 2))]


@pytest.mark.parametrize("seed", range(4))
def test_a_body_that_stands_still_is_not_odd_because_its_errors_repeat(seed):
    random = np.random.default_rng(seed)
    samples, errors = body(random, 3000)
    deviations = np.linalg.norm(errors, axis=1)
    windows = Windows.fit(deviations, errors, 1e-3, samples)

    def odd(samples, errors, place):
        deviations = np.linalg.norm(errors, axis=1)
        return windows.excess(deviations, place) > 0.0 or windows.shifted(errors, place) > 0.0

    resting, as_moving, moving = [], [], []
    for posture in samples[::40]:
        still = np.repeat(posture[None], 64, axis=0) + 0.001 * random.normal(size=(64, 4))
        errors = errors_of(still, random)
        place = windows.place(64, still)
        assert place < 1.0
        resting.append(odd(still, errors, place))
        as_moving.append(odd(still, errors, 6.0))
        still[:, 2] = np.nan  # not measured: the others say that the body stands
        assert windows.place(64, still) < 1.0
    others, errors = body(random, 6400)
    for start in range(0, 6400, 64):
        part = slice(start, start + 64)
        moving.append(windows.place(64, others[part]))
    assert np.mean(resting) <= 0.02
    assert np.mean(as_moving) >= 0.3, "the test is not worth anything if these windows are normal in full"
    assert np.mean(np.array(moving) > 5.5) >= 0.8, "a body that moves as it did counts in full"


def test_windows_of_older_models_count_in_full():
    random = np.random.default_rng(0)
    samples, errors = body(random, 1000)
    windows = Windows.fit(np.linalg.norm(errors, axis=1), errors, 1e-3)
    assert windows.scatter is None
    assert windows.place(32, np.repeat(samples[:1], 32, axis=0)) == 5.0
