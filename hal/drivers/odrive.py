"""An ODrive axis over CANSimple: a servo with a DBC file, with defaults for most of its settings.

Source: the maker's documentation (docs.odriverobotics.com, CAN Protocol and CAN Guide, firmware 0.6) and, for the
watchdog, the public firmware 0.5 (Firmware/communication/can/can_simple.cpp: every frame to the axis feeds it).
"""

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from hal.config import Positive
from hal.drivers.can_device import Place
from hal.drivers.dbc.servo import DbcServo
from hal.drivers.dbc.settings import ServoSettings
from hal.errors import ConfigError

COMMAND_BITS = 5
"""The command takes this number of low bits of an identifier; the node id is above them."""
BROADCAST = 63
"""All axes receive frames to this node id, and axes without a node id answer under it."""
STANDSTILL = 0.05
"""Below this speed [turns of the motor per second] a motor stands still."""

_MODES: dict[str, dict[str, Any]] = {
    "position": {"control": "POSITION_CONTROL", "send": "Set_Input_Pos", "signal": "Input_Pos"},
    "velocity": {"control": "VELOCITY_CONTROL", "send": "Set_Input_Vel", "signal": "Input_Vel"},
    "effort": {"control": "TORQUE_CONTROL", "send": "Set_Input_Torque", "signal": "Input_Torque"},
}
_IDLE = {"signal": "Heartbeat.Axis_State", "equals": "IDLE", "within": 0.5}


def _state(state: str, until: dict[str, Any]) -> dict[str, Any]:
    return {"send": "Set_Axis_State", "values": {"Axis_Requested_State": state}, "until": until}


def _control(mode: str) -> dict[str, Any]:
    return {"send": "Set_Controller_Mode", "values": {"Control_Mode": mode, "Input_Mode": "PASSTHROUGH"}}


COMMON: dict[str, Any] = {
    "node_offset": 1 << COMMAND_BITS,
    "periods": {"Heartbeat": 0.1, "Get_Encoder_Estimates": 0.01},
    "heartbeat": {"message": "Heartbeat", "timeout": 0.35},
    "error": {"signal": "Heartbeat.Axis_Error", "good": "NONE", "bits": True},
    "state": {
        "signal": "Heartbeat.Axis_State",
        "ready": ["IDLE"],
        "enabled": ["CLOSED_LOOP_CONTROL"],
        "busy": [
            *("FULL_CALIBRATION_SEQUENCE", "MOTOR_CALIBRATION", "ENCODER_INDEX_SEARCH", "ENCODER_OFFSET_CALIBRATION"),
            *("LOCKIN_SPIN", "ENCODER_DIR_FIND", "HOMING", "ENCODER_HALL_POLARITY_CALIBRATION"),
            *("ENCODER_HALL_PHASE_CALIBRATION", "ANTICOGGING_CALIBRATION"),
        ],
        "booting": ["UNDEFINED", "STARTUP_SEQUENCE"],
        "reason": "Heartbeat.Procedure_Result",
    },
    "identity": {
        "ask": {"frame": {"id": BROADCAST << COMMAND_BITS | 0x06, "remote": True, "broadcast": True}},
        "signals": ["Address.Serial_Number"],
    },
    "disable": [_state("IDLE", _IDLE)],
    # Stop by the drive's own velocity control, then power off; an axis that does not confirm this is sent an Estop.
    "quick_stop": [
        _control("VELOCITY_CONTROL"),
        {
            "send": "Set_Input_Vel",
            "until": {"signal": "Get_Encoder_Estimates.Vel_Estimate", "below": STANDSTILL, "within": 0.3},
        },
        _state("IDLE", {**_IDLE, "within": 0.3}),
        {"send": "Estop", "unless": {"signal": "Heartbeat.Axis_State", "equals": "IDLE"}, "until": _IDLE},
    ],
    "reset": [{"send": "Clear_Errors", "until": {"signal": "Heartbeat.Axis_Error", "equals": "NONE", "within": 0.5}}],
}
"""These settings hold for every axis in every mode."""


def profile(mode: str, gear: float, watchdog_timeout: float) -> dict[str, Any]:
    """Return the settings of one axis as a servo with a DBC file.

    Args:
        mode: `position`, `velocity` or `effort`.
        gear: Motor turns per turn of the output.
        watchdog_timeout: axis.config.watchdog_timeout [s].
    """
    turn = 2.0 * math.pi / gear
    command = _MODES[mode]
    return {
        **COMMON,
        "quantities": {
            "position": {"signal": "Get_Encoder_Estimates.Pos_Estimate", "scale": turn},
            "velocity": {"signal": "Get_Encoder_Estimates.Vel_Estimate", "scale": turn},
            "effort": {"signal": "Get_Torques.Torque_Estimate", "scale": gear},
            "temperature": {"signal": "Get_Temperature.FET_Temperature"},
            "motor_temperature": {"signal": "Get_Temperature.Motor_Temperature"},
            "current": {"signal": "Get_Iq.Iq_Measured"},
            "voltage": {"signal": "Get_Bus_Voltage_Current.Bus_Voltage"},
        },
        # Also sent while disabled: it feeds the watchdog, and the axis starts from its present position.
        "command": {
            "quantity": mode,
            "send": command["send"],
            "signal": command["signal"],
            "scale": gear if mode == "effort" else turn,
            "while_disabled": True,
        },
        "enable": [
            _control(command["control"]),
            _state(
                "CLOSED_LOOP_CONTROL",
                {"signal": "Heartbeat.Axis_State", "equals": "CLOSED_LOOP_CONTROL", "within": 1.0},
            ),
        ],
        "watchdog": {
            "timeout": watchdog_timeout,
            "fed_by": [command["send"]],
            "expired": {"signal": "Heartbeat.Axis_Error", "equals": "WATCHDOG_TIMER_EXPIRED"},
        },
    }


class OdriveSettings(ServoSettings):
    """Settings of an axis. All other settings of a servo with a DBC file have defaults from `profile`."""

    mode: Literal["position", "velocity", "effort"] = "position"
    """Commanded quantity."""
    gear: Positive = 1.0
    """Motor turns per turn of the output."""
    watchdog_timeout: Annotated[float, Field(ge=0.05, le=5.0)] = 0.2
    """Value of axis.config.watchdog_timeout [s]; axis.config.enable_watchdog must be set."""

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, settings: dict[str, Any]) -> dict[str, Any]:
        mode, gear = settings.get("mode", "position"), settings.get("gear", 1.0)
        if mode not in _MODES or not isinstance(gear, int | float) or not gear > 0:
            mode, gear = "position", 1.0  # the field's own check reports the error
        timeout = settings.get("watchdog_timeout", 0.2)
        periods = {**COMMON["periods"], **settings.get("periods", {})}
        return {**profile(mode, gear, timeout), **settings, "periods": periods}


class Odrive(DbcServo):
    """One axis of an ODrive."""

    Settings: ClassVar[type[OdriveSettings]] = OdriveSettings

    def __init__(self, place: Place, settings: OdriveSettings) -> None:
        if place.node == BROADCAST:
            raise ConfigError(f"Device {place}: node id {BROADCAST} is for axes that have none yet; use 0 to 62.")
        super().__init__(place, settings)
