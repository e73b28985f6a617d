"""One seed of every fault of the campaign, in lockstep; `make faults` runs many."""

import pytest
from campaign import Run
from campaign_faults import FAULTS


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_no_rule_is_broken_by(fault):
    outcome = Run(fault, 0).play()
    assert not outcome.violated
    assert outcome.recovered
