"""Settings and data sheets of CANopen nodes that are refused before anything is opened, in a sentence."""

import pytest
from drive_bench import FIXED, joint_description, refused, without
from hal_bench import ROBOTS

from hal.config import RobotConfig
from hal.errors import ConfigError
from hal.robot import open_robot


@pytest.mark.parametrize(
    ("gone", "how", "report"),
    [
        ("60FF", {"mode": "csv", "quantities": ("velocity",)}, "cannot receive 60FFh:0 by PDO: its data sheet has no"),
        ("606C", {"quantities": ("position", "velocity")}, "cannot send 606Ch:0 by PDO: its data sheet has no such"),
        ("6098", {"homing": {"method": 1, "speed": 1, "slow_speed": 1}}, "needs object 6098h:0 for homing"),
        ("6065", {"following_error": 0.1}, "needs object 6065h:0 for following_error"),
        ("6081", {"mode": "profile_position", "profile": {"velocity": 1}}, "6081h:0 for profile.velocity"),
        ("6076", {"mode": "cst", "quantities": ("effort",)}, "6076h:0 for the rated torque (or the setting rated_to"),
        ("1016", {}, "has no object 1016h by its data sheet, so it would go on moving when the HAL is gone"),
        ("1802", {"quantities": ("position", "velocity", "temperature")}, "would need TPDO3 to send 2200h:1 (16 bit)"),
    ],
)
def test_a_data_sheet_that_lacks_something_is_told_before_anything_is_opened(tmp_path, gone, how, report):
    assert report in refused(sheet=without(tmp_path, gone), **how)


def test_another_devices_data_sheet_is_told():
    assert "has device profile 404, not 402" in refused(sheet=ROBOTS / "eds" / "load_cell.eds")


@pytest.mark.parametrize(
    ("how", "report"),
    [
        ({"gear": 0}, "gear: Input should be greater than 0"),
        ({"counts_per_turn": 0}, "counts_per_turn: Input should be greater than 0"),
        ({"counts_per_turn": float("nan")}, "counts_per_turn: Input should be"),
        ({"damping": 1.0}, "damping needs the mode cst, not csp."),
        ({"profile": {"velocity": 1.0}}, "profile needs the mode profile_position, not csp."),
        ({"temperature": {"object": "hot", "type": "int16"}}, "'hot' is not an object such as 6064h or 2200h:1."),
        ({"temperature": {"object": "2200h:1", "scale": 0}}, "a scale of 0 makes every temperature the same."),
        ({"mode": "jog"}, "mode: Input should be 'profile_position', 'csp', 'csv' or 'cst'"),
        ({"node": 0}, "a CANopen node id is 1 to 127."),
        ({"node": 128}, "a CANopen node id is 1 to 127."),
        (
            {"pdo": {**FIXED, "sends": FIXED["sends"][:0]}},
            "needs to send 6041h:0 (16 bit), 6064h:0 (32 bit); its setting",
        ),
        (
            {"pdo": {**FIXED, "sends": [{**FIXED["sends"][0], "transmission": 2}]}},
            "no PDO in pdo.sends has transmission 1, so no PDO answers a cycle.",
        ),
        (
            {"pdo": {**FIXED, "receives": [{"number": 1, "objects": ["6040h uint16", "607Ah int32", "6072h uint16"]}]}},
            "pdo.receives has 6072h:0 (16 bit), which would be sent as 0.",
        ),
    ],
)
def test_settings_that_cannot_be_are_told_in_a_sentence(how, report):
    how = dict(how)
    mode = how.pop("mode", "csp")
    if mode == "jog":
        body = joint_description()
        body["kinds"]["drive"]["settings"]["mode"] = mode
        with pytest.raises(ConfigError, match="mode: Input should be"):
            open_robot(RobotConfig.model_validate(body))
        return
    assert report in refused(mode, **how)
