import math

import pytest

from hal.calibration.line import rotary, spool


def test_a_spool_winds_its_circumference_in_one_turn():
    line = spool(counts_per_turn=4096, gear=29, direction=1, zero=0.3, radius=0.008)
    assert line.to_si(0) == 0.3
    assert line.to_si(4096 * 29) == pytest.approx(0.3 + 2 * math.pi * 0.008)
    assert line.to_counts(line.to_si(-12_345)) == -12_345


def test_direction_turns_the_sign_of_counts_only():
    line = rotary(counts_per_turn=1000, gear=2, direction=-1, zero=0.1)
    assert line.to_si(500) == pytest.approx(0.1 - math.pi / 2)
    assert line.to_counts(0.1) == 0
