"""A robot file that is wrong is refused in one sentence before anything is enabled, and with a ConfigError only."""

import copy
import string

import numpy as np
import pytest
import yaml
from hal_bench import ROBOTS, Bench, description
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from hal import registry
from hal.calibration import store
from hal.clock import ManualClock
from hal.config import RobotConfig, load_robot
from hal.errors import CommandRefused, ConfigError, HalError
from hal.reading.mistakes import explain
from hal.robot import open_robot


def refused(body, tmp_path):
    """Why a robot file is refused; nothing is opened by that."""
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump({**body, "folder": str(ROBOTS)}))
    with pytest.raises(ConfigError) as caught:
        open_robot(load_robot(path).model_copy(update={"folder": ROBOTS}))
    return str(caught.value)


def is_one_sentence(text):
    return "\n" not in text and text.endswith((".", "?")) and len(text) < 400


def test_two_devices_with_one_node_id(tmp_path):
    body = description()
    body["devices"]["biceps_cell"]["node"] = 1
    report = refused(body, tmp_path)
    assert "'biceps_cell' and 'biceps_drive' both claim node 1 on bus 'can0'" in report
    assert is_one_sentence(report)


@pytest.mark.parametrize(
    ("signal", "unit", "report"),
    [
        ("muscle_length", "rad", "Device 'biceps_drive' has its position in m, and the unit of muscle_length is rad."),
        ("joint_position", "m", "has its position in rad, and the unit of joint_position is m. Change the unit"),
    ],
)
def test_a_signal_in_another_unit_than_its_device(tmp_path, signal, unit, report):
    body = description(limits={})
    body["signals"][signal]["unit"] = unit
    text = refused(body, tmp_path)
    assert report in text


def test_a_wire_without_a_spool(tmp_path):
    body = description()
    body["kinds"]["drive"]["settings"] = {**body["kinds"]["drive"]["settings"], "spool_radius": None}
    text = refused(body, tmp_path)
    assert "has its position in rad, and the unit of muscle_length is m." in text
    assert text.endswith("Does it lack spool_radius?")


def test_a_gear_of_zero(tmp_path):
    body = description()
    body["kinds"]["drive"]["settings"] = {**body["kinds"]["drive"]["settings"], "gear": 0}
    report = refused(body, tmp_path)
    assert "'biceps_drive'" in report
    assert "gear" in report
    assert is_one_sentence(report)


@pytest.mark.parametrize(
    ("kind", "eds", "report"),
    [
        ("drive", "load_cell.eds", "404"),
        ("cell", "joint_encoder.eds", "406"),
        ("encoder", "servo_drive.eds", "402"),
        ("drive", "none.eds", "There is no EDS file"),
    ],
)
def test_an_eds_that_does_not_fit(tmp_path, kind, eds, report):
    body = description()
    body["kinds"][kind]["settings"] = {**body["kinds"][kind]["settings"], "eds": f"eds/{eds}"}
    found = refused(body, tmp_path)
    assert report in found
    assert is_one_sentence(found)


def test_an_eds_of_another_maker_is_found_when_the_device_answers(tmp_path):
    """The file may read well and be the wrong one: vendor and product are compared before the node is told anything."""
    text = (ROBOTS / "eds" / "servo_drive.eds").read_text()
    head, section, rest = text.partition("[1018sub1]")
    other = tmp_path / "other.eds"
    before, key, after = rest.partition("DefaultValue=")
    other.write_text(head + section + before + key + "0x4D41" + after[after.index("\n") :])
    body = description()
    body["kinds"]["drive"]["settings"] = {**body["kinds"]["drive"]["settings"], "eds": str(other)}
    bench = Bench(RobotConfig.model_validate(body)).open()
    try:
        bench.cycle(5)
        report = bench.device("biceps_drive")["text"]
        assert "vendor" in report
        assert is_one_sentence(report)
        with pytest.raises(CommandRefused):
            bench.robot.enable()
        assert not any(enabled for _, enabled in bench.world.drives.values())
    finally:
        bench.close()


def test_limits_that_exclude_where_the_robot_is():
    body = description()
    body["limits"]["muscle_length"] = {"low": 0.1, "high": 0.2, "rate": 0.25}
    bench = Bench(RobotConfig.model_validate(body)).open()
    try:
        bench.cycle(5)
        before = bench.world.length.copy()
        with pytest.raises(CommandRefused) as caught:
            bench.robot.enable()
        assert "biceps" in str(caught.value)
        assert is_one_sentence(str(caught.value))
        bench.cycle(20)
        assert not any(enabled for _, enabled in bench.world.drives.values())
        np.testing.assert_array_equal(bench.world.length, before)
    finally:
        bench.close()


def places(value, here=()):
    """Every place in a nested mapping, as a tuple of keys."""
    found = [here] if here else []
    if isinstance(value, dict):
        for key, inner in value.items():
            found += places(inner, (*here, key))
    return found


BODY = {key: value for key, value in description().items() if key != "folder"}
PLACES = places(BODY)
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**40), 2**40),
    st.floats(allow_nan=True, allow_infinity=True),
    st.text(string.printable, max_size=12),
    st.sampled_from(["muscle_length.biceps", "can0", "drive", "eds/servo_drive.eds", "virtual", 0, -1, 1e-300]),
)
VALUES = st.one_of(SCALARS, st.lists(SCALARS, max_size=3), st.dictionaries(st.text(max_size=6), SCALARS, max_size=3))
DELETE = object()
CHANGES = st.lists(st.tuples(st.sampled_from(PLACES), st.one_of(st.just(DELETE), VALUES)), min_size=1, max_size=3)


@pytest.mark.long
@settings(max_examples=400, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(CHANGES)
def test_any_change_of_a_robot_file_is_taken_or_refused_in_a_sentence(changes):
    body = copy.deepcopy(BODY)
    for place, value in changes:
        inner = body
        for key in place[:-1]:
            inner = inner.get(key, {}) if isinstance(inner, dict) else {}
        if isinstance(inner, dict) and value is DELETE:
            inner.pop(place[-1], None)
        elif isinstance(inner, dict):
            inner[place[-1]] = value
    try:
        config = load_from(body)
        robot = open_robot(config, ManualClock())
    except HalError as error:
        assert isinstance(error, ConfigError)
        assert str(error).strip()
        return
    assert robot.mode == "off"


def load_from(body):
    """The robot of a mapping, refused as `load_robot` refuses it."""
    try:
        return RobotConfig.model_validate({**body, "folder": ROBOTS})
    except ValidationError as error:
        raise ConfigError(explain(error, RobotConfig)) from None


@pytest.mark.parametrize(
    ("text", "report"),
    [
        ("[" * 20_000, "nested too deeply"),
        ("robot: a\nrates: {hal: 1" + "0" * 5000 + "}", "A value cannot be read"),
        ("robot: 2025-13-45", "A value cannot be read"),
        ("robot: !!python/object/apply:os.system [true]", "is not YAML"),
    ],
    ids=["nested", "number", "date", "object"],
)
@pytest.mark.long
def test_a_text_that_is_no_yaml_is_one_sentence(tmp_path, text, report):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=report) as caught:
        load_robot(path)
    assert "\n" not in str(caught.value)
    config = RobotConfig.model_validate({**description(), "folder": tmp_path})
    store.path_of(config).write_text(text)
    with pytest.raises(ConfigError, match="cannot be read"):
        store.load(config)


@pytest.mark.parametrize("name", ["..:x", ".:x", "a\0b:x", "os:system", "hal.config:load_robot"])
def test_what_is_no_driver_is_one_sentence(name):
    with pytest.raises(ConfigError) as caught:
        registry.driver(name)
    assert "\n" not in str(caught.value)
