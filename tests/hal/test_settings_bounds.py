"""Ends and defaults of driver settings: identifiers and sub-indices by CAN and CiA 301, others by docs/devices.md."""

import pytest
from pydantic import ValidationError

from hal.drivers.canopen.analog import InputSettings
from hal.drivers.canopen.cia406 import Cia406Encoder
from hal.drivers.cia402.settings import DriveSettings
from hal.drivers.dbc.settings import DbcSettings, FrameConfig, QuantityConfig, ServoSettings, UntilConfig
from hal.drivers.mit.settings import MitSettings
from hal.drivers.odrive import OdriveSettings

DRIVE = {"eds": "drive.eds", "counts_per_turn": 4096}
HOMING = {"method": 17, "speed": 1.0, "slow_speed": 0.1}
TEMPERATURE = {"object": "2200h:1"}
MIT = {"motor": "DM4310", "stiffness": 1.0, "damping": 1.0}
INPUT = {"eds": "input.eds"}
DBC = {"dbc": "a.dbc", "periods": {"A": 0.1}, "quantities": {"force": {"signal": "A.B"}}}
FRAME = {"id": 1}
ODRIVE = {"dbc": "odrive.dbc"}


@pytest.mark.parametrize(
    ("kind", "given", "name", "low", "high", "beyond"),
    [
        (DriveSettings, DRIVE, "watch_time", 0.1, 5.0, (0.099, 5.01)),
        (DriveSettings, DRIVE, "max_torque", 0, 10_000, (-1, 10_001)),
        (DriveSettings, DRIVE, "homing.method", -128, 127, (-129, 128)),
        (DriveSettings, DRIVE, "temperature.every", 1, 240, (0, 241)),
        (MitSettings, MIT, "watch_time", 0.02, 5.0, (0.019, 5.01)),
        (MitSettings, MIT, "master_id", 0, 0x7FF, (-1, 0x800)),
        (MitSettings, MIT, "ramp", 0.0, 1e6, (-0.001, float("inf"))),
        (OdriveSettings, ODRIVE, "watchdog_timeout", 0.05, 5.0, (0.049, 5.01)),
        (InputSettings, INPUT, "channels", [1], [254], ([0], [255], [], [1, 1])),
        (InputSettings, INPUT, "resolution", 2, 32, (1, 33)),
        (InputSettings, INPUT, "bad_status", 1, 0xFFFF_FFFF, (0,)),
        (FrameConfig, FRAME, "id", 0, (1 << 29) - 1, (-1, 1 << 29)),
        (FrameConfig, FRAME, "data", [0] * 8, [255] * 8, ([0] * 9, [-1], [256])),
        (DbcSettings, DBC, "node_offset", 0, 1 << 20, (-1,)),
        (DbcSettings, DBC, "gain", -1e-9, 1e9, (0.0, float("inf"), float("nan"))),
    ],
)
def test_ends(kind, given, name, low, high, beyond):
    section, _, key = name.rpartition(".")
    inner = {"homing": HOMING, "temperature": TEMPERATURE}.get(section, {})

    def settings(value):
        return kind.model_validate({**given, **({section: {**inner, key: value}} if section else {key: value})})

    settings(low)
    settings(high)
    for value in beyond:
        with pytest.raises(ValidationError, match=key):
            settings(value)


@pytest.mark.parametrize(
    ("kind", "given", "defaults"),
    [
        (
            DriveSettings,
            DRIVE,
            {
                "mode": "csp",
                "gear": 1.0,
                "direction": 1,
                "zero": 0.0,
                "watch_time": 0.15,
                "silent_after": 0.15,
                "spool_radius": None,
                "rated_torque": None,
                "max_torque": None,
                "allow_no_watchdog": False,
            },
        ),
        (
            MitSettings,
            MIT,
            {
                "mode": "position",
                "gear": 1.0,
                "direction": 1,
                "zero": 0.0,
                "ramp": 0.5,
                "watch_time": 0.15,
                "max_effort": None,
                "allow_no_watchdog": False,
                "silent_after": 0.15,
                "master_id": None,
            },
        ),
        (OdriveSettings, ODRIVE, {"mode": "position", "gear": 1.0, "watchdog_timeout": 0.2, "direction": 1}),
        (
            InputSettings,
            INPUT,
            {
                "measures": "force",
                "channels": (1,),
                "gain": None,
                "zero": 0.0,
                "bad_status": 0xFFFF_FFFF,
                "preset": "int16",
                "resolution": None,
                "frozen_after": None,
            },
        ),
        (Cia406Encoder.Settings, {"eds": "e.eds"}, {"counts_per_turn": None, "direction": 1, "zero": 0.0}),
        (
            DbcSettings,
            DBC,
            {"node_offset": 0, "extended": None, "direction": 1, "zero": 0.0, "gain": 1.0, "silent_after": 0.15},
        ),
        (QuantityConfig, {"signal": "A.B"}, {"scale": 1.0, "offset": 0.0}),
        (UntilConfig, {"signal": "A.B", "equals": 1}, {"within": 0.5}),
        (FrameConfig, FRAME, {"data": (), "remote": False, "broadcast": False}),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_defaults(kind, given, defaults):
    settings = kind.model_validate(given)
    assert {name: getattr(settings, name) for name in defaults} == defaults


@pytest.mark.parametrize(
    "name",
    [
        "quantities",
        "periods",
        "enable",
        "disable",
        "state.enabled",
        "state.ready",
        "watchdog.fed_by",
        "identity.signals",
    ],
)
def test_lists_that_must_not_be_empty(name):
    step = {"send": "Go"}
    given = {
        **DBC,
        "quantities": {"effort": {"signal": "A.B"}},
        "command": {"quantity": "effort", "send": "Go", "signal": "X"},
        "state": {"signal": "A.S", "ready": ["OFF"], "enabled": ["ON"]},
        "enable": [step],
        "disable": [step],
        "watchdog": {"timeout": 1.0, "fed_by": ["Go"]},
        "identity": {"signals": ["A.B"]},
    }
    ServoSettings.model_validate(given)
    section, _, key = name.rpartition(".")
    empty = {} if name in ("quantities", "periods") else []
    changed = {section: {**given[section], key: empty}} if section else {key: empty}
    with pytest.raises(ValidationError, match=key):
        ServoSettings.model_validate({**given, **changed})


def test_defaults_of_sections():
    drive = DriveSettings.model_validate({**DRIVE, "homing": HOMING, "temperature": TEMPERATURE})
    assert (drive.homing.timeout, drive.homing.offset, drive.homing.acceleration) == (60.0, 0.0, None)
    temperature = drive.temperature
    assert (temperature.type, temperature.scale, temperature.zero, temperature.every) == ("int16", 0.1, 0.0, 20)
    with pytest.raises(ValidationError, match="scale"):
        DriveSettings.model_validate({**DRIVE, "temperature": {**TEMPERATURE, "scale": 0.0}})
