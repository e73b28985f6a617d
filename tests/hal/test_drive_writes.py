"""The objects that a servo drive gets before it is used, in the drive's units: values by arithmetic done by hand.

The joint has 4096 counts per motor turn, a gear of 50 and its zero at -0.2 rad: 204 800 counts per turn of the joint,
so 32 594.93 counts per radian. The wire has a spool of 10 mm: 3 259 493 counts per metre.
"""

import math

import canopen
import pytest
from drive_bench import HOMING, SETTINGS
from hal_bench import ROBOTS

from hal.drivers.canopen.node import data_sheet
from hal.drivers.cia402.settings import DriveSettings, drive_units
from hal.drivers.cia402.writes import ERROR_BEHAVIOUR, check_objects, drive_writes
from hal.errors import ConfigError
from hal.protocols.cia301 import mapped
from hal.protocols.cia402 import VELOCITY_UNITS

ANYWHERE = (-math.inf, math.inf)


def writes(bounds=ANYWHERE, unit="counts/s", period=0.005, **settings):
    """Values by object."""
    parsed = DriveSettings.model_validate({**SETTINGS, **settings})
    units = drive_units(parsed, VELOCITY_UNITS[unit], 0.2)
    sheet = data_sheet(ROBOTS / "eds" / "servo_drive.eds")
    return {str(item): value for item, value in drive_writes(parsed, units, bounds, period, sheet)}


def test_what_every_drive_gets():
    assert mapped("1029h:1", "uint8") == ERROR_BEHAVIOUR
    assert writes() == {
        "6060h:0": 8,
        "60C2h:1": 5,
        "60C2h:2": -3,
        "6007h:0": 3,
        "1029h:1": 0,
        "605Ah:0": 2,
    }


@pytest.mark.parametrize(("mode", "code"), [("profile_position", 1), ("ip", 7), ("csp", 8), ("csv", 9), ("cst", 10)])
def test_modes(mode, code):
    written = writes(mode=mode)
    assert written["6060h:0"] == code
    assert written.get("60C0h:0") == (0 if mode == "ip" else None)


def test_homing_has_a_speed_to_the_switch_and_a_slower_one_to_the_zero():
    homing = {**HOMING, "acceleration": 2.0, "offset": -0.5}
    found = writes(homing=homing)
    assert [found[item] for item in ("6098h:0", "6099h:1", "6099h:2", "609Ah:0", "607Ch:0")] == [
        17,
        32_595,  # 1 rad/s
        3_259,  # 0.1 rad/s
        65_190,  # 2 rad/s2
        -16_297,  # -0.5 rad
    ]
    backwards = writes(homing=homing, direction=-1)
    assert [backwards[item] for item in ("6099h:1", "609Ah:0", "607Ch:0")] == [32_595, 65_190, 16_297]
    assert not {"609Ah:0", "607Ch:0"} & set(writes(homing=HOMING))


def test_a_profile_in_the_drives_velocity_unit():
    profile = {"velocity": 1.0, "acceleration": 2.0, "deceleration": 4.0}
    found = writes(mode="profile_position", profile=profile)
    assert [found[item] for item in ("6081h:0", "6083h:0", "6084h:0")] == [32_595, 65_190, 130_380]
    found = writes(mode="profile_position", profile=profile, unit="rpm")  # 1 rad/s is 477.46 rpm of the motor
    assert [found[item] for item in ("6081h:0", "6083h:0", "6084h:0")] == [477, 955, 1910]
    assert not {"6083h:0", "6084h:0"} & set(writes(mode="profile_position", profile={"velocity": 1.0}))


def test_limits_that_the_robot_file_states():
    found = writes(max_velocity=2.0, max_torque=900, following_error=0.01)
    assert found["607Fh:0"] == 65_190  # counts/s
    assert found["6080h:0"] == 955  # rpm of the motor: 2 rad/s * 50 * 60 / (2 pi)
    assert found["6072h:0"] == 900
    assert found["6065h:0"] == 326  # counts: 0.01 rad


def test_a_wire_on_a_spool():
    found = writes(spool_radius=0.01, max_velocity=0.1, following_error=0.001)
    assert found["607Fh:0"] == 325_949
    assert found["6080h:0"] == 4775  # rpm: 0.1 m/s / 0.01 m is 10 rad/s of the spool
    assert found["6065h:0"] == 3259


@pytest.mark.parametrize(
    ("settings", "bounds", "low", "high"),
    [
        # the range, a tenth of it wider on both sides, and 0.2 rad between the zero and the counts
        ({}, (-1.2, 0.8), -32_595 - 6_519, 32_595 + 6_519),
        ({"direction": -1}, (-1.2, 0.8), -32_595 - 6_519, 32_595 + 6_519),
        ({"direction": -1}, (-0.2, 0.8), -35_854, 3_259),
        ({}, (-1.2, math.inf), -32_595, 2**31 - 1),
        ({}, (-math.inf, 0.8), 1 - 2**31, 32_595),
        ({"direction": -1}, (-math.inf, 0.8), -32_595, 2**31 - 1),
        ({"direction": -1}, (-1.2, math.inf), 1 - 2**31, 32_595),
    ],
)
def test_the_range_of_positions(settings, bounds, low, high):
    found = writes(bounds, **settings)
    assert (found["607Dh:1"], found["607Dh:2"]) == (low, high)
    assert "6072h:0" not in found
    assert "607Fh:0" not in found


def test_the_range_of_velocities_and_of_torques():
    found = writes((-1.0, 2.0), mode="csv")
    assert found["607Fh:0"] == 71_709  # counts/s: 2.2 rad/s
    assert found["6080h:0"] == 1050  # rpm of the motor
    assert "607Dh:1" not in found
    assert writes((-1.0, 2.0), mode="csv", max_velocity=1.0)["607Fh:0"] == 32_595
    assert "607Fh:0" not in writes((-math.inf, 2.0), mode="csv")
    found = writes((-3.001, 2.0), mode="cst")  # 1 N m is 100 thousandths of 0.2 N m times 50
    assert found["6072h:0"] == 301
    assert "607Fh:0" not in found
    assert writes((-3.001, 2.0), mode="cst", max_torque=50)["6072h:0"] == 50
    assert writes((-1e9, 2.0), mode="cst")["6072h:0"] == 65_535
    assert "6072h:0" not in writes(mode="cst")


def test_a_bound_is_at_least_one_unit():
    assert writes(following_error=1e-9)["6065h:0"] == 1
    assert writes(following_error=1e9)["6065h:0"] == 2**31 - 1


def test_the_period_of_set_points():
    found = writes(period=0.0025)
    assert (found["60C2h:1"], found["60C2h:2"]) == (25, -4)


def test_damping_and_a_profile_need_their_modes():
    for mode, changes in (("csp", {"damping": 1.0}), ("csp", {"profile": {"velocity": 1.0}})):
        with pytest.raises(ValueError, match="needs the mode"):
            DriveSettings.model_validate({**SETTINGS, "mode": mode, **changes})
    with pytest.raises(ConfigError):
        data_sheet(ROBOTS / "eds" / "no_drive.eds")


HOMED = {"homing": {**HOMING, "acceleration": 2.0, "offset": 0.1}}
NEEDED = [
    ({}, "6060h:0"),
    ({"max_torque": 900}, "6072h:0"),
    ({"following_error": 0.01}, "6065h:0"),
    ({"mode": "profile_position", "profile": {"velocity": 1.0}}, "6081h:0"),
    ({"mode": "profile_position", "profile": {"acceleration": 1.0}}, "6083h:0"),
    ({"mode": "profile_position", "profile": {"deceleration": 1.0}}, "6084h:0"),
    (HOMED, "6098h:0"),
    (HOMED, "6099h:1"),
    (HOMED, "6099h:2"),
    (HOMED, "609Ah:0"),
    (HOMED, "607Ch:0"),
]


def sheet_without(item):
    sheet = canopen.import_od(str(ROBOTS / "eds" / "servo_drive.eds"))
    index, sub = int(item[:4], 16), int(item[6:])
    if sub:
        del sheet[index].subindices[sub]
    else:
        del sheet[index]
    return sheet


@pytest.mark.parametrize(("settings", "item"), NEEDED)
def test_a_setting_whose_object_the_drive_does_not_have(settings, item):
    parsed = DriveSettings.model_validate({**SETTINGS, **settings})
    sheet = sheet_without(item)
    with pytest.raises(ConfigError, match=f"object {item} for"):
        check_objects(parsed, False, sheet, "'elbow'")
    if settings:
        check_objects(DriveSettings.model_validate(SETTINGS), False, sheet, "'elbow'")
    check_objects(parsed, True, data_sheet(ROBOTS / "eds" / "servo_drive.eds"), "'elbow'")


def test_homing_without_acceleration_and_offset_needs_no_objects_for_them():
    parsed = DriveSettings.model_validate({**SETTINGS, "homing": HOMING})
    for item in ("609Ah:0", "607Ch:0"):
        check_objects(parsed, False, sheet_without(item), "'elbow'")


def test_an_effort_needs_the_rated_torque_from_the_drive_or_the_robot_file():
    parsed = DriveSettings.model_validate(SETTINGS)
    with pytest.raises(ConfigError, match="object 6076h:0 for"):
        check_objects(parsed, True, sheet_without("6076h:0"), "'elbow'")
    check_objects(parsed, False, sheet_without("6076h:0"), "'elbow'")
    given = DriveSettings.model_validate({**SETTINGS, "rated_torque": 0.2})
    check_objects(given, True, sheet_without("6076h:0"), "'elbow'")


def test_a_drive_that_cannot_watch_the_hal_is_refused_unless_the_robot_file_accepts_it():
    sheet = sheet_without("1016h:1")
    with pytest.raises(ConfigError, match="allow_no_watchdog"):
        check_objects(DriveSettings.model_validate(SETTINGS), False, sheet, "'elbow'")
    check_objects(DriveSettings.model_validate({**SETTINGS, "allow_no_watchdog": True}), False, sheet, "'elbow'")


def test_objects_that_the_drive_does_not_have_or_that_are_read_only_are_left_to_the_hal():
    parsed = DriveSettings.model_validate({**SETTINGS, "max_velocity": 1.0})
    sheet = sheet_without("6080h:0")
    sheet[0x605A].access_type = "ro"
    units = drive_units(parsed, VELOCITY_UNITS["counts/s"], 0.2)
    found = {str(item) for item, _ in drive_writes(parsed, units, ANYWHERE, 0.005, sheet)}
    assert not {"6080h:0", "605Ah:0"} & found
    assert {"607Fh:0", "6007h:0", "1029h:1"} <= found
