"""Units of robots and measured data: those in use, their spellings, and the conversion of others into them."""

import difflib
import math

CONVERSIONS = {
    "deg": ("rad", math.pi / 180.0),
    "deg/s": ("rad/s", math.pi / 180.0),
    "deg/s^2": ("rad/s^2", math.pi / 180.0),
    "rpm": ("rad/s", math.pi / 30.0),
    "rev": ("rad", 2.0 * math.pi),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "um": ("m", 1e-6),
    "mm/s": ("m/s", 1e-3),
    "km/h": ("m/s", 1.0 / 3.6),
    "g": ("kg", 1e-3),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "min": ("s", 60.0),
    "h": ("s", 3600.0),
    "mN": ("N", 1e-3),
    "kN": ("N", 1e3),
    "kgf": ("N", 9.80665),
    "N mm": ("N m", 1e-3),
    "N cm": ("N m", 1e-2),
    "kN m": ("N m", 1e3),
    "mA": ("A", 1e-3),
    "mV": ("V", 1e-3),
    "kPa": ("Pa", 1e3),
    "MPa": ("Pa", 1e6),
    "bar": ("Pa", 1e5),
}
"""Each unit in a file has this SI unit and this factor."""

SPELLINGS = {
    "rad": ("radian", "radians"),
    "deg": ("degree", "degrees", "°"),
    "rad/s": ("rad/sec", "radps", "rads", "rad_s", "rad_per_s", "radians/s", "rad s-1", "rad*s^-1", "1/s rad"),
    "deg/s": ("deg/sec", "°/s", "dps", "degps", "degs", "deg_s", "deg_per_s", "degrees/s"),
    "m": ("meter", "meters", "metre", "metres"),
    "m/s": ("m/sec", "mps", "m_s", "m_per_s"),
    "km/h": ("kmh", "kph", "kmph", "km_h"),
    "m/s^2": ("m/s2", "mps2", "m/s²", "m/s/s", "m_s2"),
    "rad/s^2": ("rad/s2", "rad/s²", "rad/s/s"),
    "N": ("newton", "newtons"),
    "N m": ("nm", "n*m", "n·m", "n.m", "n-m", "newtonmeter", "newton meter"),
    "N mm": ("nmm", "n*mm", "n·mm"),
    "N cm": ("ncm", "n*cm", "n·cm"),
    "s": ("sec", "second", "seconds"),
    "ms": ("msec", "millis", "milliseconds"),
    "us": ("µs", "usec", "micros", "microseconds"),
    "ns": ("nsec", "nanos", "nanoseconds"),
    "V": ("volt", "volts"),
    "A": ("amp", "amps", "ampere"),
    "degC": ("°c", "celsius"),
    "kg": ("kilogram",),
    "rpm": ("1/min", "u/min", "rev/min"),
    "1": ("-", "", "none", "[-]", "count", "counts", "raw"),
}
"""Each unit is also written in these ways, in lower case."""

NAMED = {spelling: unit for unit, spellings in SPELLINGS.items() for spelling in spellings}
PLAIN = {*SPELLINGS, *CONVERSIONS, "Pa", "K", "px", "Hz", "%", "W"}
"""These units are written as they are."""
OTHERS = ("m^2", "m^3", "m^3/s", "kg/s", "N/m", "N m/rad", "N s", "px/s", "J", "ohm", "T", "lx", "dB")
"""A robot may have these units too."""
ROBOT_UNITS = (*sorted(PLAIN - {*CONVERSIONS}, key=str.lower), *OTHERS)
"""A signal of a robot has one of these units."""


def axis_units(is_linear: bool) -> dict[str, str]:
    """Return the unit of every quantity of a drive that winds a wire or, if it is not linear, turns a joint."""
    length, force = ("m", "N") if is_linear else ("rad", "N m")
    motion = {"position": length, "following_error": length, "velocity": f"{length}/s", "effort": force}
    return motion | {"temperature": "degC", "temperature_driver": "degC"}


def check_units(unit: str, written_in: str | None) -> None:
    """Refuse a unit that the model does not use, or that the numbers of a file cannot be converted to.

    Raises:
        ValueError: A sentence with the unit to write instead.
    """
    for text in (unit, written_in):
        proper = None if text is None or text in PLAIN else NAMED.get(text.lower())
        if proper is not None:
            raise ValueError(f"the unit '{text}' is written '{proper}'")
    if unit in CONVERSIONS:
        raise ValueError(
            f"'{unit}' is not the unit of the model; write unit: {CONVERSIONS[unit][0]} and written_in: {unit}"
        )
    if written_in not in (None, unit) and CONVERSIONS.get(written_in or "", ("", 0))[0] != unit:
        known = ", ".join(own for own, (si, _) in CONVERSIONS.items() if si == unit) or "nothing"
        raise ValueError(f"'{written_in}' cannot be converted to '{unit}'; to '{unit}' can be converted: {known}")


def factor(unit: str, written_in: str | None) -> float:
    """Return the factor from a number of a file to `unit`."""
    return 1.0 if written_in in (None, unit) else CONVERSIONS[str(written_in)][1]


def check_robot_unit(unit: str) -> None:
    """Refuse a unit that a signal of a robot cannot have, because drivers and limits would read its numbers as SI.

    Raises:
        ValueError: A sentence with the unit to write instead.
    """
    if unit in ROBOT_UNITS:
        return
    if not unit:
        raise ValueError("a signal needs a unit, such as rad, N m, or 1 for a number without one")
    proper = unit if unit in CONVERSIONS else NAMED.get(unit.lower(), "")
    if proper in CONVERSIONS:
        raise ValueError(
            f"'{unit}' is not an SI unit; write unit: {CONVERSIONS[proper][0]}, and written_in: {proper} beside its "
            "numbers in limits, stop and collect.constraints"
        )
    if proper:
        raise ValueError(f"the unit '{unit}' is written '{proper}'")
    near = difflib.get_close_matches(unit.lower(), [*ROBOT_UNITS, *CONVERSIONS], 1)
    hint = f"; is it '{near[0]}'?" if near else "."
    raise ValueError(f"the unit '{unit}' is unknown{hint} Known units: {', '.join(ROBOT_UNITS)}")
