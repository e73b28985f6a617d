"""Signals that the HAL computes, and signals that it has never heard of."""

import numpy as np
import pytest
from hal_bench import description
from pydantic import ValidationError

from hal.clock import ManualClock
from hal.computed import center_of_pressure
from hal.config import RobotConfig
from hal.device import Device, DeviceHealth, DeviceState, Reading
from hal.errors import ConfigError
from hal.robot import Robot

POINTS = [[0.04, 0.02], [0.04, -0.02], [-0.04, 0.02], [-0.04, -0.02]]
PRESSURE = {"by": "hal.computed:center_of_pressure", "from": "foot_force", "settings": {"points": POINTS}}


def feet(**changes):
    """One commanded joint, four load cells under a sole, the center of gravity above it, and a camera."""
    gravity = {"unit": "m", "elements": ["x", "y"], "computed": PRESSURE | changes.pop("computed", {})}
    signals = {
        "joint_position": {"unit": "rad", "elements": ["hip"]},
        "center_of_gravity": gravity,
        "foot_force": {"unit": "N", "elements": ["a", "b", "c", "d"], "stale_after": 0.05},
        "tool_tip_pixel": {"unit": "px", "elements": ["u", "v"], "source": "vision", "stale_after": 0.2},
    }
    command = {"signal": "joint_position", "time_to_live": 0.1, "hold": 0.5}
    body = description(signals=signals, command=command, limits={}, devices={})
    return RobotConfig.model_validate(body | changes)


class Sole(Device):
    """All that is measured, at times that the test sets."""

    name = "sole"
    commands = ("joint_position.hip",)

    def __init__(self, clock, config, seen=False):
        self.measures = tuple(config.element_names(config.measured + (config.seen if seen else ())))
        self.values = np.array([0.3, 1.0, 2.0, 3.0, 4.0, *([320.0, 240.0] if seen else [])])
        self.received = np.full(len(self.values), clock.monotonic())

    def open(self):
        pass

    def read(self):
        return Reading(self.values, self.received)

    def health(self):
        return DeviceHealth(DeviceState.READY)

    def close(self):
        pass


def sample_of(clock, config, **given):
    device = Sole(clock, config, given.pop("seen", False))
    for name, value in given.items():
        getattr(device, name)[1:5] = value
    with Robot(config, [device], clock=clock) as robot:
        return robot.cycle()[0]


@pytest.fixture
def clock():
    return ManualClock()


def test_the_center_of_pressure_is_the_mean_of_the_points_by_force():
    points = np.array(POINTS)
    assert center_of_pressure(np.full(4, 5.0), points) == pytest.approx([0.0, 0.0])
    assert center_of_pressure(np.array([10.0, 0.0, 0.0, 0.0]), points) == pytest.approx(POINTS[0])
    assert center_of_pressure(np.array([3.0, 3.0, 1.0, 1.0]), points) == pytest.approx([0.02, 0.0])


@pytest.mark.parametrize("forces", [[0.1, 0.1, 0.1, 0.1], [5.0, -5.0, 0.0, 0.0], [np.nan, 5.0, 5.0, 5.0]])
def test_a_foot_in_the_air_has_no_center_of_pressure(forces):
    assert np.isnan(center_of_pressure(np.array(forces), np.array(POINTS))).all()


def test_a_computed_signal_is_of_the_same_sample_in_the_files_order(clock):
    sample = sample_of(clock, feet())
    assert list(sample.values) == ["joint_position", "center_of_gravity", "foot_force"]
    assert sample.values["center_of_gravity"] == pytest.approx([-0.016, -0.004])
    assert sample.valid["center_of_gravity"].all()


def test_it_is_valid_only_if_every_input_is(clock):
    sample = sample_of(clock, feet(), values=[1.0, np.nan, 3.0, 4.0])
    assert sample.valid["foot_force"].tolist() == [True, False, True, True]
    assert not sample.valid["center_of_gravity"].any()
    assert np.isnan(sample.values["center_of_gravity"]).all()
    assert not sample_of(clock, feet(), values=0.01).valid["center_of_gravity"].any()


def test_it_is_as_old_as_the_oldest_input(clock):
    now = clock.monotonic()
    sample = sample_of(clock, feet(), received=[now, now - 0.013, now - 0.002, now])
    assert sample.age["center_of_gravity"] == pytest.approx([0.013, 0.013])
    stale = sample_of(clock, feet(), received=[now, now - 0.03, now, now])
    assert stale.valid["foot_force"].all()
    assert not stale.valid["center_of_gravity"].any(), "older than its own stale_after of 20 ms"


def test_what_a_camera_sees_is_served_only_where_a_device_measures_it(clock):
    assert "tool_tip_pixel" not in sample_of(clock, feet()).values
    seen = sample_of(clock, feet(), seen=True)
    assert seen.values["tool_tip_pixel"].tolist() == [320.0, 240.0]


@pytest.mark.parametrize(
    ("computed", "report"),
    [
        ({"by": "hal.computed:center_of_mass"}, "has no 'center_of_mass'"),
        ({"settings": {}}, "cannot be computed by hal.computed:center_of_pressure from 4 values of foot_force"),
        ({"settings": {"points": POINTS[:3]}}, "with the settings points"),
        ({"settings": {"points": [[*point, 0.0] for point in POINTS]}}, "has shape (3,), but the signal has 2"),
    ],
)
def test_what_cannot_be_computed_is_told_before_anything_opens(clock, computed, report):
    config = feet(computed=computed)
    with pytest.raises(ConfigError) as caught:
        Robot(config, [Sole(clock, config)], clock=clock)
    assert report in str(caught.value)


def signals_with(name, **changes):
    signals = {key: signal.model_dump(by_alias=True) for key, signal in feet().signals.items()}
    signals[name] |= changes
    return {"signals": signals}


@pytest.mark.parametrize(
    ("changes", "report"),
    [
        (signals_with("center_of_gravity", computed=PRESSURE | {"from": "feet"}), "joint_position, foot_force"),
        (
            signals_with("center_of_gravity", computed=PRESSURE | {"from": "tool_tip_pixel"}),
            "not a signal that devices",
        ),
        (signals_with("center_of_gravity", source="vision"), "is computed by the HAL"),
        (signals_with("joint_position", source="vision"), "must be measured by devices"),
        (signals_with("tool_tip_pixel", source="radar"), "'hal', 'vision' or 'ros2'"),
        ({"limits": {"tool_tip_pixel": {"trip_high": 600}}}, "the HAL's, which does not see this signal"),
        ({"conditions": ["plain", "plain"]}, "conditions must be names that differ"),
    ],
)
def test_mistakes_are_told_in_one_sentence(changes, report):
    with pytest.raises(ValidationError) as caught:
        feet(**changes)
    assert report in str(caught.value)


def test_every_measured_element_needs_a_device_and_no_other_may_have_one():
    devices = {
        f"{element}_cell": {"kind": "cell", "bus": "can0", "node": node, "element": f"foot_force.{element}"}
        for node, element in enumerate("abcd", 11)
    }
    drive = {"kind": "drive", "bus": "can0", "node": 1, "element": "joint_position.hip"}
    assert len(feet(devices=devices | {"hip_drive": drive}).devices) == 5
    with pytest.raises(ValueError, match=r"no device measures joint_position.hip. Add one, remove the element, or set"):
        feet(devices=devices)
    camera = drive | {"element": "tool_tip_pixel.u", "node": 2}
    with pytest.raises(ValueError, match=r"'tool_tip_pixel.u', which a device cannot measure"):
        feet(devices=devices | {"hip_drive": drive, "camera": camera})


def test_an_unknown_key_of_a_computed_signal_lists_the_known_ones(tmp_path):
    from hal.config import load_robot

    path = tmp_path / "feet.yaml"
    path.write_text(
        "robot: feet\nsignals:\n  a: {unit: N, elements: [x], computed: {by: m:n, form: a}}\ncommand: {signal: a}\n"
    )
    with pytest.raises(ConfigError, match="Known keys there: by, from, settings"):
        load_robot(path)
