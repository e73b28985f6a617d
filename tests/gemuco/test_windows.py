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
    assert not any(windows.shifted(window) > 0.0 for window in fresh)
    assert np.mean([windows.shifted(window + 0.5) > 0.0 for window in fresh]) > 0.9
