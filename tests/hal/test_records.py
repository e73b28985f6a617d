"""Records cannot be changed once they are made, and take no attribute that they do not have."""

import dataclasses

import pytest

from hal.calibration import line
from hal.drivers import can_device
from hal.drivers.canopen import analog as channels
from hal.drivers.cia402 import settings
from hal.drivers.dbc import sequence
from hal.protocols import analog, cia301, cia402, error_frames, mit, mit_motors
from hal.safety import emergency, feedback, limit

MODULES = (
    *(analog, cia301, cia402, error_frames, mit, mit_motors),
    *(can_device, channels, settings, sequence),
    *(line, emergency, feedback, limit),
)
CHANGING = {limit.CycleState, channels.Channel, sequence.InputMessage, sequence.InputSignal, sequence.Condition}
RECORDS = [
    kind
    for module in MODULES
    for kind in vars(module).values()
    if dataclasses.is_dataclass(kind) and isinstance(kind, type) and kind.__module__ == module.__name__
]


def test_records_are_found():
    assert set(RECORDS) >= CHANGING
    assert len(RECORDS) > 25


@pytest.mark.parametrize("kind", RECORDS, ids=lambda kind: kind.__name__)
def test_a_record_is_frozen_and_has_slots(kind):
    record = object.__new__(kind)
    name = dataclasses.fields(kind)[0].name
    assert not hasattr(record, "__dict__")
    if kind in CHANGING:
        setattr(record, name, 1)
        assert getattr(record, name) == 1
    else:
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(record, name, 1)
