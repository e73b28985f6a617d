"""Ranges of motors in MIT mode: the values at the largest counts of their frames.

A wrong range is a wrong speed or torque, and no frame shows it. So every row has its source, and a note where sources
disagree. The driver reads the ranges of a Damiao drive on opening. Those of other drives cannot be read: compare the
row with the manual of your motor and its firmware, and override it in the robot file.
"""

from dataclasses import dataclass

from hal.errors import ConfigError
from hal.protocols.mit import Layout, Ranges

CUBEMARS = "CubeMars AK Series Actuator Driver Manual V1.0.8, section 5.3, p. 50"
OPENARM = (
    "github.com/enactic/openarm_can at 9866604, include/openarm/damiao_motor/dm_motor_constants.hpp "
    "(MOTOR_LIMIT_PARAMS); gains: src/openarm/damiao_motor/dm_motor_control.cpp"
)
DAMIAO_DRIVER = "github.com/jia-xie/python-damiao-driver at 3c6773a, docs/concept/registers.md (_MOTOR_LIMIT_PARAM)"
MINI_CHEETAH = (
    "github.com/bgkatz/motorcontrol at 3586419, Core/Src/main.c (defaults of P_MAX, V_MAX, KP_MAX, KD_MAX) and "
    "Core/Src/can.c (comment above unpack_cmd: 18 N m)"
)
_TMOTORCANCONTROL = "github.com/neurobionics/TMotorCANControl at bb8d071, src/TMotorCANControl/mit_can.py"
_DFKI = (
    "github.com/dfki-ric-underactuated-lab/mini-cheetah-tmotor-python-can at 0ef9f89, src/motor_driver/canmotorlib.py"
)


@dataclass(frozen=True, slots=True)
class Motor:
    """A motor with its drive.

    Attributes:
        ranges: Ranges of its frames.
        layout: Layout of its answers.
        source: Source of the ranges.
        note: Other sources that disagree; empty if none is known.
    """

    ranges: Ranges
    layout: Layout
    source: str
    note: str = ""


def _t_motor(velocity: float, effort: float, note: str = "") -> Motor:
    return Motor(Ranges(12.5, velocity, effort), Layout.T_MOTOR, CUBEMARS, note)


def _damiao(position: float, velocity: float, effort: float, note: str = "", source: str = OPENARM) -> Motor:
    return Motor(Ranges(position, velocity, effort), Layout.DAMIAO, source, note)


MOTORS: dict[str, Motor] = {
    "mini-cheetah": Motor(
        Ranges(12.5, 65.0, 18.0),
        Layout.MINI_CHEETAH,
        MINI_CHEETAH,
        "The firmware keeps its ranges in flash; its torque is I_MAX * KT * GR from there: read them on its console.",
    ),
    "AK10-9": _t_motor(50.0, 65.0),
    "AK60-6": _t_motor(45.0, 15.0, f"50 rad/s in {_TMOTORCANCONTROL}; the maker's manual was taken."),
    "AK70-10": _t_motor(50.0, 25.0, f"24 N m for firmware V1.1 in {_DFKI}; the maker's manual was taken."),
    "AK80-6": _t_motor(
        76.0,
        12.0,
        f"Older firmware differs: V1.0 has 95.5 rad, 45 rad/s, 18 N m and V1.1 22.5 rad/s in {_DFKI}, whose README has "
        "38.2 rad/s for V2; the maker's manual was taken.",
    ),
    "AK80-9": _t_motor(
        50.0,
        18.0,
        f"25.64 rad/s for firmware V2 and 22.5 rad/s for V1.1 in {_DFKI}; the maker's manual was taken, with which "
        "TMotorCANControl agrees.",
    ),
    "AK80-64": _t_motor(8.0, 144.0, "The manual's column is named AK80-80."),
    "DM3507": _damiao(
        12.566,
        50.0,
        5.0,
        "12.5 rad in openarm_can; 12.566 rad also in the maker's table on wiki.seeedstudio.com/damiao_series.",
        DAMIAO_DRIVER,
    ),
    "DM4310": _damiao(12.5, 30.0, 10.0),
    "DM4310-48V": _damiao(12.5, 50.0, 10.0, "30 rad/s on wiki.seeedstudio.com/damiao_series."),
    "DM4310P": _damiao(12.5, 50.0, 10.0, source=DAMIAO_DRIVER),
    "DM4340": _damiao(
        12.5,
        10.0,
        28.0,
        "8 rad/s in older sources (github.com/cmjang/DM_Control_Python at 7da9387, DM_CAN.py; "
        "wiki.seeedstudio.com/damiao_series); openarm_can pull request 146 read 10 from the register of a motor.",
    ),
    "DM4340-48V": _damiao(12.5, 10.0, 28.0, "8 rad/s on wiki.seeedstudio.com/damiao_series."),
    "DM6006": _damiao(12.5, 45.0, 20.0),
    "DM8006": _damiao(12.5, 45.0, 40.0),
    "DM8009": _damiao(12.5, 45.0, 54.0),
    "DM10010L": _damiao(12.5, 25.0, 200.0),
    "DM10010": _damiao(12.5, 20.0, 200.0),
    "DMH3510": _damiao(12.5, 280.0, 1.0),
    "DMH6215": _damiao(12.5, 45.0, 10.0),
    "DMG6220": _damiao(12.5, 45.0, 10.0),
}


def motor(name: str) -> Motor:
    """Return a motor of the table.

    Raises:
        ConfigError: It is not in the table.
    """
    if name not in MOTORS:
        raise ConfigError(
            f"There is no motor '{name}'. Known: {', '.join(MOTORS)}. For another one give `ranges` with position, "
            "velocity, effort and layout."
        )
    return MOTORS[name]
