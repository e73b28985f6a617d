from pathlib import Path

import pytest
from hal_bench import description

from hal import registry
from hal.config import RobotConfig, load_robot
from hal.drivers.cia402.drive import Cia402Drive
from hal.errors import ConfigError
from hal.protocols.can_frames import frame_bits
from hal.robot import open_robot
from hal.wire import budget

MUSASHI = Path(__file__).parents[2] / "robots" / "musashi_arm.yaml"


@pytest.mark.parametrize(("size", "bits"), [(0, 55), (1, 65), (2, 75), (4, 95), (5, 105), (8, 135)])
def test_worst_frames_on_the_wire(size, bits):
    assert frame_bits(size) == bits


def test_the_musashi_arm_takes_under_half_of_each_bus():
    found = budget.budgets(load_robot(MUSASHI))
    assert [one.bus for one in found] == ["can0", "can1"]
    assert found[0].bits == 55 + 5 * (115 + 115) + 5 * 105 + 3 * 135
    assert found[0].frames == 1 + 10 + 5 + 3
    assert found[0].load == pytest.approx((2135 * 200 + 13 * 650 + 50 * 65) / 1e6)
    assert all(0.4 < one.load < 0.5 for one in found)


def test_a_bus_that_would_carry_too_much_is_refused_with_the_arithmetic():
    config = load_robot(MUSASHI)
    fast = config.model_copy(update={"rates": config.rates.model_copy(update={"hal": 400.0})})
    with pytest.raises(ConfigError) as caught:
        open_robot(fast)
    assert "19 frames of together 2135 bits at 400 Hz" in str(caught.value)
    assert "87% of 1 Mbit/s" in str(caught.value)
    assert "max_load is 60%" in str(caught.value)
    assert "Lower rates.hal to 276 Hz" in str(caught.value)


def test_finds_drivers_by_name_and_by_module():
    assert registry.driver("cia402") is Cia402Drive
    assert registry.driver("hal.drivers.cia402.drive:Cia402Drive") is Cia402Drive


@pytest.mark.parametrize(
    ("name", "report"),
    [
        ("nonsense", "not of the form 'module:name'"),
        (":x", "not of the form"),
        ("no_such_module_here:x", "No module named"),
        ("os:system", "part of Python and not a function of a robot"),
        ("numpy:pi", "'numpy:pi' is not a function"),
        ("hal.robot:Robbot", "has no 'Robbot'. It has: .*Robot"),
    ],
)
def test_names_that_stand_for_nothing(name, report):
    with pytest.raises(ConfigError, match=report):
        registry.load_object(name)


def test_an_unknown_driver_lists_the_known():
    with pytest.raises(ConfigError, match=r"Known: cia402, cia401, cia404, cia406"):
        registry.driver("cia999")


def refused(**changes):
    with pytest.raises(ConfigError) as caught:
        open_robot(RobotConfig.model_validate(description(**changes)))
    return str(caught.value)


def kinds(**drive):
    body = description()["kinds"]
    body["drive"] = {"driver": "cia402", "settings": {**body["drive"]["settings"], **drive}}
    return body


def test_settings_of_a_device_are_checked():
    assert "unknown key 'gaer'. Known keys there: silent_after, eds, pdo, mode, counts_per_turn, gear" in refused(
        kinds=kinds(gaer=29)
    )
    assert "Settings of device 'biceps_drive': gear" in refused(kinds=kinds(gear=0))
    assert "direction" in refused(kinds=kinds(direction=2))


def test_a_missing_or_broken_data_sheet_is_told(tmp_path):
    assert "There is no EDS file" in refused(kinds=kinds(eds="eds/none.eds"))
    broken = tmp_path / "broken.eds"
    broken.write_text("nothing\nof this is an EDS")
    assert "is not an EDS file" in refused(kinds=kinds(eds=str(broken)))


def test_an_unknown_interface_is_told():
    buses = {name: {"interface": "telepathy", "channel": "x"} for name in ("can0", "can1")}
    assert "interface 'telepathy' is not known to python-can. Known: " in refused(buses=buses)


def devices(**drive):
    body = description()["devices"]
    body["biceps_drive"] = {"kind": "drive", "bus": "can0", "node": 1, "element": "muscle_length.biceps", **drive}
    return {name: {key: value for key, value in one.items() if value is not None} for name, one in body.items()}


def test_a_device_may_name_the_quantities_that_it_measures():
    by_name = devices(element=None, elements={"position": "muscle_length.biceps"})
    robot = open_robot(RobotConfig.model_validate(description(devices=by_name)))
    assert next(device.measures for device in robot._devices) == ("muscle_length.biceps",)


def test_a_quantity_that_a_driver_does_not_have_is_told():
    report = refused(devices=devices(element=None, elements={"colour": "muscle_length.biceps"}))
    assert "Device 'biceps_drive' has no quantity colour. With these settings it has position" in report


def test_a_node_id_that_canopen_does_not_have_is_told():
    assert "'biceps_drive' (node 200 on can0): a CANopen node id is 1 to 127" in refused(devices=devices(node=200))
