"""The faults of the campaign that a whole process has, in real time; `make faults` runs more."""

import pytest
from campaign import Outcome
from campaign_processes import break_master


@pytest.mark.parametrize(("name", "duration"), [("killed", None), pytest.param("frozen", 0.3, marks=pytest.mark.long)])
def test_a_drive_stops_by_itself_when_the_hal_is(name, duration):
    outcome = break_master(Outcome(name, 0), duration)
    assert not outcome.violated
    assert outcome.recovered
