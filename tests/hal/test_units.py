"""Factors of units by their definitions, and the units that are refused."""

import math
import re

import pytest

from hal.calibration.units import CONVERSIONS, PLAIN, check_units, factor

DEFINED = {
    "deg": ("rad", math.radians(1)), "deg/s": ("rad/s", math.radians(1)), "deg/s^2": ("rad/s^2", math.radians(1)),
    "rpm": ("rad/s", 2 * math.pi / 60), "rev": ("rad", math.tau),
    "mm": ("m", 0.001), "cm": ("m", 0.01), "um": ("m", 0.000_001), "mm/s": ("m/s", 0.001), "km/h": ("m/s", 1000 / 3600),
    "g": ("kg", 0.001),
    "ms": ("s", 0.001), "us": ("s", 0.000_001), "ns": ("s", 0.000_000_001), "min": ("s", 60), "h": ("s", 3600),
    "mN": ("N", 0.001), "kN": ("N", 1000), "kgf": ("N", 9.80665),
    "N mm": ("N m", 0.001), "N cm": ("N m", 0.01), "kN m": ("N m", 1000),
    "mA": ("A", 0.001), "mV": ("V", 0.001), "kPa": ("Pa", 1000), "MPa": ("Pa", 1_000_000), "bar": ("Pa", 100_000),
}  # fmt: skip


def test_each_unit_has_its_factor():
    assert {unit: (si, pytest.approx(size, rel=1e-12)) for unit, (si, size) in DEFINED.items()} == CONVERSIONS


@pytest.mark.parametrize("written_in", DEFINED)
def test_numbers_of_a_file_are_converted(written_in):
    unit, size = DEFINED[written_in]
    check_units(unit, written_in)
    assert factor(unit, written_in) == pytest.approx(size, rel=1e-12)
    assert factor(unit, None) == factor(unit, unit) == 1.0
    with pytest.raises(ValueError, match=re.escape(f"write unit: {unit} and written_in: {written_in}")):
        check_units(written_in, None)


def test_a_unit_that_is_written_as_it_is_needs_no_conversion():
    for unit in PLAIN - set(CONVERSIONS):
        check_units(unit, None)
        check_units(unit, unit)


@pytest.mark.parametrize(("unit", "written_in", "proper"), [("Nm", None, "N m"), ("rad", "Degrees", "deg")])
def test_another_spelling_is_refused_with_the_proper_one(unit, written_in, proper):
    with pytest.raises(ValueError, match=f"is written '{proper}'"):
        check_units(unit, written_in)
