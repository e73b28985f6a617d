"""Sensors that lie through the real wire: the node is healthy, and what it measures is wrong."""

import math

import pytest
from bench import bench

from simulators.lies import LIES, known_lies, lie_of
from simulators.rig import UnknownFault


@pytest.mark.parametrize(
    ("text", "measured"),
    [("sensor_offset hinge_encoder 0.5", lambda v: v + 0.5), ("sensor_frozen hinge_encoder", lambda v: v),
     ("sensor_gain hinge_encoder 2", lambda v: 2 * v), ("sensor_flipped hinge_encoder", lambda v: -v),
     ("sensor_wrapped hinge_encoder", lambda v: v + 2 * math.pi), ("sensor_clipped hinge_encoder -1", lambda v: -1.0)],
)  # fmt: skip
def test_an_encoder_lies_until_it_is_told_the_truth(text, measured):
    with bench() as b:
        plant, element = b.rig._plant, b.rig.node("hinge_encoder").spec.element
        true = plant.value(element)
        assert b.rig.fault(text).startswith("hinge_encoder ")
        assert plant.read(element) == pytest.approx(measured(true))
        assert "as it is" in b.rig.fault("sensor_true hinge_encoder")
        assert plant.read(element) == true


def test_a_drift_grows_and_noise_varies():
    drifting, _ = lie_of("sensor_drift", ["0.1"], 1.0, 10.0)
    assert drifting(1.0, 10.0) == 1.0
    assert drifting(1.0, 12.0) == pytest.approx(1.2)
    noisy, _ = lie_of("sensor_noisy", ["0.1"], 1.0, 10.0)
    drawn = [noisy(1.0, 0.0) for _ in range(2000)]
    assert sum(drawn) / 2000 == pytest.approx(1.0, abs=0.02)
    assert len(set(drawn)) == 2000


def test_a_stuck_sensor_changes_its_bits_and_not_its_value():
    stuck, _ = lie_of("sensor_stuck", ["0.01"], 1.0, 10.0)
    drawn = [stuck(5.0 + number, 10.0 + number) for number in range(2000)]
    assert sum(drawn) / 2000 == pytest.approx(1.0, abs=0.002)
    assert len(set(drawn)) == 2000


def test_a_delayed_sensor_reads_what_was():
    delayed, sentence = lie_of("sensor_delayed", ["0.2"], 1.0, 10.0)
    assert sentence == "reads the value of 0.2 s ago"
    read = [delayed(1.0 + 0.1 * step, 10.0 + 0.1 * step) for step in range(1, 8)]
    assert read == pytest.approx([1.0, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5])
    assert delayed(1.7, 10.7) == pytest.approx(1.5), "read twice in one step"


def test_two_sensors_are_swapped_and_back():
    with bench() as b:
        plant = b.rig._plant
        hinge, cell = (b.rig.node(name).spec.element for name in ("hinge_encoder", "wire_cell"))
        plant.snapshot.values[hinge.split(".")[0]][0] = 0.25
        b.rig.fault("sensors_swapped hinge_encoder wire_cell")
        assert plant.read(cell) == plant.value(hinge)
        assert plant.read(hinge) == plant.value(cell)
        b.rig.fault("sensor_true wire_cell")
        assert plant.read(hinge) == plant.value(hinge)


WRONG = (
    "sensor_offset hinge_encoder", "sensor_offset hinge_encoder much", "sensor_frozen", "sensor_frozen hinge_encoder 3",
    "sensors_swapped hinge_encoder", "sensor_gain nobody 2",
)  # fmt: skip


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_lie_is_refused(text):
    with bench() as b, pytest.raises(UnknownFault):
        b.rig.fault(text)


def test_all_lies_are_listed():
    with bench() as b, pytest.raises(UnknownFault, match="sensor_noisy NODE STD"):
        b.rig.fault("sensor_asleep hinge_encoder")
    assert len(known_lies()) == len(LIES) + 2
