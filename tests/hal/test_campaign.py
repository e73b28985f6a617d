"""One seed of every fault of the campaign; `make faults` runs many."""

import pytest
from campaign import Outcome, Run
from campaign_faults import FAULTS
from campaign_processes import break_master


def check(outcome):
    assert not outcome.violated
    assert outcome.recovered


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_no_rule_is_broken_by(fault):
    check(Run(fault, 0).play())


@pytest.mark.parametrize(("name", "duration"), [("killed", None), ("frozen", 0.3)])
def test_a_drive_stops_by_itself_when_the_hal_is(name, duration):
    check(break_master(Outcome(name, 0), duration))
