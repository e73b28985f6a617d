"""One seed of every fault of the campaign, in lockstep; `make faults` runs many. And: the campaign can fail."""

import numpy as np
import pytest
from campaign import Run
from campaign_faults import FAULTS, LIES
from wire_bench import WireBench

from hal.safety.following import Following
from hal.safety.plausibility import Plausibility

NAMED = {fault.name: fault for fault in LIES}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
@pytest.mark.long
def test_no_rule_is_broken_by(fault):
    outcome = Run(fault, 0).play()
    assert not outcome.violated
    assert outcome.recovered


@pytest.mark.parametrize("name", ["encoder at random places", "sensor's answer frozen", "cell with the other sign"])
@pytest.mark.long
def test_the_referee_sees_it_when_nothing_is_doubted(name, monkeypatch):
    monkeypatch.setattr(Plausibility, "check", lambda self, values, received, valid: valid)
    assert "stale" in Run(NAMED[name], 0).play().violated


@pytest.mark.parametrize("name", ["drive says enabled and is off", "drive's encoder jumps 30 mm or more"])
@pytest.mark.long
def test_the_referee_sees_it_when_nobody_looks_whether_drives_follow(name, monkeypatch):
    monkeypatch.setattr(Following, "problem", lambda self, measured, now: "")
    assert "reaction" in Run(NAMED[name], 0).play().violated


def test_the_referee_sees_a_nan_that_is_called_valid():
    bench = WireBench()
    with bench.referee as referee:
        bench.open()
        bench.cycle(3)
        assert not referee.violations
        bench.sample.values["muscle_tension"][0] = np.nan
        referee.look()
        bench.close()
    assert "muscle_tension[0] is NaN, called valid" in referee.violations["stale"]
