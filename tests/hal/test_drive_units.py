"""What a drive's numbers are worth, by arithmetic done by hand."""

import math
from pathlib import Path

import pytest
from drive_bench import ELBOW, HOMING, SETTINGS, joint_description

from hal.config import RobotConfig
from hal.drivers.cia402.drive import Cia402Drive
from hal.drivers.cia402.modes import SetPointHandshake
from hal.drivers.cia402.settings import DriveSettings, drive_units
from hal.errors import ConfigError
from hal.protocols.cia402 import VELOCITY_UNITS
from hal.robot import open_robot
from hal.wire import budget


def units(unit="counts/s", rated_torque=0.2, **settings):
    return drive_units(DriveSettings.model_validate({**SETTINGS, **settings}), VELOCITY_UNITS[unit], rated_torque)


def test_a_joint():
    joint = units()
    assert joint.counts(-0.2) == 0
    assert joint.counts(-0.2 + 2 * math.pi) == 4096 * 50
    assert joint.speed(1.0) == 32595  # 4096 * 50 / 2 pi
    assert joint.torque(1.0) == 100  # 1 N m of 0.2 N m * 50, in thousandths
    assert joint.effort == pytest.approx(0.01)


def test_a_wire_on_a_spool():
    wire = units(spool_radius=0.01, zero=0.1)
    assert wire.counts(0.1 + 2 * math.pi * 0.01) == 4096 * 50
    assert wire.speed(0.1) == 325949
    assert wire.torque(-100.0) == -100  # 100 N * 0.01 m / 50 = 0.02 N m, a tenth of 0.2 N m


def test_against_the_counts():
    joint = units(direction=-1)
    assert joint.counts(0.8) < 0
    assert joint.speed(1.0) == -32595
    assert joint.torque(1.0) == -100


@pytest.mark.parametrize(
    ("unit", "one_radian_per_second"), [("rps", 8), ("rpm", 477), ("0.1 rpm", 4775), ("mrpm", 477465)]
)
def test_velocities_of_the_motor(unit, one_radian_per_second):
    assert units(unit).speed(1.0) == one_radian_per_second


def test_what_does_not_fit_is_cut():
    joint = units()
    assert joint.counts(1e9) == 2**31 - 1
    assert joint.counts(-1e9) == -(2**31 - 1)
    assert joint.speed(-1e9) == -(2**31 - 1)
    assert joint.torque(1e9) == 2**15 - 1


def test_traffic_is_that_of_the_quantities_which_the_file_names():
    settings = DriveSettings.model_validate({**SETTINGS, "temperature": {"object": "2200h:1", "every": 20}})
    beat = (1, 10.0)
    assert Cia402Drive.traffic_of(settings, 200.0, ("position",), Path()) == ((6, 200.0), (6, 200.0), beat)
    every = ((6, 200.0), (8, 200.0), (8, 200.0), (2, 10.0), beat)
    assert Cia402Drive.traffic_of(settings, 200.0, settings.quantities, Path()) == every
    (one,) = budget.budgets(RobotConfig.model_validate(joint_description(quantities=("position",))))
    (all_of_them,) = budget.budgets(RobotConfig.model_validate(joint_description()))
    assert all_of_them.bits > one.bits
    assert set(ELBOW) == set(settings.quantities)


def objects(pdos):
    return [" ".join(str(item) for item in pdo.objects) for pdo in pdos]


def test_slow_objects_come_with_every_20th_sync_or_by_the_event_timer():
    """CiA 301, table 31: 254 is the event timer of the maker; its entry is in sub-index 5."""
    for timing, transmission, event_time in (({}, 20, 0.0), ({"every": 5}, 5, 0.0), ({"event_time": 0.1}, 254, 0.1)):
        temperature = {"object": "2200h:1", **timing}
        settings = DriveSettings.model_validate({**SETTINGS, "temperature": temperature, "homing": HOMING})
        pdos = settings.pdos(("position", "temperature"))
        assert objects(pdos.sends) == ["6041h:0 6064h:0", "2200h:1 6061h:0"]
        assert [pdo.number for pdo in pdos.sends] == [1, 2]
        assert (pdos.sends[1].transmission, pdos.sends[1].event_time) == (transmission, event_time)
        assert objects(pdos.receives) == ["6040h:0 6060h:0 607Ah:0"]
    settings = DriveSettings.model_validate({**SETTINGS, "homing": HOMING})
    sends = settings.pdos(("velocity",)).sends
    assert objects(sends) == ["6041h:0 6064h:0", "606Ch:0", "6061h:0"]  # a position drive starts from its position
    assert [(pdo.number, pdo.transmission) for pdo in sends] == [(1, 1), (2, 1), (3, 20)]


def test_a_set_point_stays_until_it_is_acknowledged_and_the_newest_is_next():
    taken = 1 << 12
    handshake = SetPointHandshake()
    handshake.start(100)
    assert handshake.step(100, 0) == (0, 100)
    assert handshake.step(110, 0) == (0x30, 110)
    assert handshake.step(120, 0) == (0x30, 110)  # not taken yet
    assert handshake.step(130, taken) == (0, 110)
    assert handshake.step(140, taken) == (0, 110)  # bit 12 must fall first
    assert handshake.step(150, 0) == (0x30, 150)
    handshake.start(7)
    assert handshake.step(7, 0) == (0, 7)


def test_a_misspelt_key_inside_a_section_lists_the_known():
    body = joint_description(quantities=("position",), homing={"method": 17, "speed": 1, "slow_sped": 1})
    with pytest.raises(
        ConfigError, match=r"unknown key 'homing.slow_sped'. Known keys there: method, speed, slow_speed"
    ):
        open_robot(RobotConfig.model_validate(body))
