"""A device drafted from an EDS or DCF file: its profile, its node id, and what the file says of its encoder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import canopen

from hal.commissioning.pdo_map import check_map, chosen_pdos, is_fixed
from hal.drivers.cia402 import Cia402Drive
from hal.errors import ConfigError
from hal.finding.draft.parts import Measure, Names, Part
from hal.protocols import cia301, cia402
from hal.protocols.eds import read_sheet, value_of

PROFILES = {402: "drive", 406: "encoder", 404: "cell", 401: "input"}
"""Each device profile with a driver, and the word for such devices in names."""
FIRST_NODES = {402: 1, 406: 31, 404: 51, 401: 71}
"""Node ids of the devices of a profile count from here, if no file states them."""
SIGNS = ((0x6041, 402), (0x6004, 406), (0x9130, 404), (0x7130, 404), (0x6130, 404), (0x6401, 401), (0x6403, 401))
"""An object that shows the profile of a file which does not state 1000h, the first one first."""
MODES = ((8, "csp", (0x607A, 0)), (7, "ip", (0x60C1, 1)), (1, "profile_position", (0x607A, 0)))
"""Modes of operation that a position can be commanded in, names, objects of their set-points, the preferred
one first."""

INPUT_PRESETS = ((0x6401, "int16"), (0x6402, "int32"), (0x6403, "float32"))
CELL_PRESETS = ((0x9130, "int32"), (0x6130, "float32"), (0x7130, "int16"), (0x9100, "counts32"), (0x7100, "counts16"))
"""Object of the value -> setting, the preferred one first."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """An EDS or DCF file.

    Attributes:
        path: The file.
        profile: Number of the device profile; 0 if it is not known.
        vendor: Vendor number; None if not stated.
        product: Product code; None if not stated.
        node: Node id of a DCF file; None if not stated.
        dictionary: All of its objects.
    """

    path: Path
    profile: int
    vendor: int | None
    product: int | None
    node: int | None
    dictionary: canopen.ObjectDictionary

    def number(self, index: int, subindex: int = 0) -> int | None:
        """Return a stated value; None without one."""
        return _number(self.dictionary, index, subindex)


def read(path: Path) -> Sheet:
    """Read an EDS or DCF file.

    Raises:
        ConfigError: It cannot be read.
    """
    dictionary = read_sheet(path)
    stated = (_number(dictionary, cia301.DEVICE_TYPE, 0) or 0) & 0xFFFF
    signs = (profile for index, profile in SIGNS if index in dictionary)
    device = dictionary.device_information
    vendor, product = _number(dictionary, 0x1018, 1), _number(dictionary, 0x1018, 2)
    return Sheet(
        path,
        stated or next(signs, 0),
        vendor or getattr(device, "vendor_number", None),
        product or getattr(device, "product_number", None),
        getattr(dictionary, "node_id", None),
        dictionary,
    )


def _number(dictionary: canopen.ObjectDictionary, index: int, subindex: int) -> int | None:
    variable = dictionary.get_variable(index, subindex)
    value = None if variable is None else value_of(variable)
    return value if isinstance(value, int) else None


def part_of(sheet: Sheet, eds: str, names: Names, node: int, moved: str, name: str = "") -> Part:
    """Return the device of a file.

    Args:
        sheet: The file.
        eds: Its path as the robot file has it.
        names: Names that were given.
        node: Node id.
        moved: Signal of a drive.
        name: Name of the device; that of the file if empty.

    Raises:
        ConfigError: There is no driver for its profile.
    """
    if sheet.profile not in PROFILES:
        what = f"device profile {sheet.profile}" if sheet.profile else "no device profile that is known"
        drivers = ", ".join(f"{number} ({word})" for number, word in PROFILES.items())
        raise ConfigError(f"'{sheet.path.name}' has {what}; there are drivers for {drivers}.")
    own = names.new(name or sheet.path.stem)
    settings: dict[str, Any] = {"eds": eds}
    to_set = ""
    measures: tuple[Measure, ...] = ()
    if sheet.profile == 402:
        settings |= {"mode": _mode(sheet), "counts_per_turn": _counts(sheet, 0x608F) or 4096, "gear": 1.0}
        to_set = "gear" if _counts(sheet, 0x608F) else "counts_per_turn, gear"
        measures = _measured(sheet, settings, own, moved)
        if any(measure.quantity == "effort" for measure in measures):
            is_stated = cia402.RATED_TORQUE.index in sheet.dictionary
            settings |= {} if is_stated else {"rated_torque": 1.0}
            to_set += ", rated_torque if object 6076h is not in mN m" if is_stated else ", rated_torque"
        if sheet.dictionary.get_variable(cia301.CONSUMER_HEARTBEAT, 1) is None:
            to_set += ", and allow_no_watchdog: true (without 1016h it goes on when the HAL is gone)"
    elif sheet.profile == 406:
        measures = (Measure("position", "joint_position", own, "rad"),)
        to_set = "zero, direction"
    else:
        measures = (Measure("force", "force", own, "N"),)
        presets = INPUT_PRESETS if sheet.profile == 401 else CELL_PRESETS
        preset = next((name for index, name in presets if index in sheet.dictionary), presets[0][1])
        settings |= {"preset": preset}
        if sheet.profile == 401 or preset.startswith("counts"):
            settings |= {"gain": 0.01}
            to_set = "gain [N per count]"
    driver = f"cia{sheet.profile}"
    return Part(own, driver, settings, node, measures, sheet.path.name, to_set, is_drive=sheet.profile == 402)


def _measured(sheet: Sheet, settings: dict[str, Any], own: str, moved: str) -> tuple[Measure, ...]:
    """Return position, effort and velocity of a drive, as far as its PDOs can carry them."""
    part = moved.partition("_")[0]
    measures = (
        Measure("position", moved, own, "rad"),
        Measure("effort", f"{part}_effort", own, "N m"),
        Measure("velocity", f"{part}_velocity", own, "rad/s"),
    )
    drive = Cia402Drive.Settings.model_validate(settings)
    for count in range(len(measures), 1, -1):
        pdos = drive.pdos(tuple(measure.quantity for measure in measures[:count]))
        try:
            if is_fixed(sheet.dictionary):
                pdos = chosen_pdos(sheet.dictionary, pdos, Cia402Drive.MAY_RECEIVE, own)
            check_map(pdos, sheet.dictionary, own)
        except ConfigError:
            continue
        return measures[:count]
    return measures[:1]


def _mode(sheet: Sheet) -> str:
    """Return the first mode that 6502h has, if stated, and whose set-point a PDO can carry; else cyclic positions."""
    stated = sheet.number(0x6502)
    for mode, name, place in MODES:
        target = sheet.dictionary.get_variable(*place)
        if (stated is None or stated >> mode - 1 & 1) and target is not None and target.pdo_mappable:
            return name
    return MODES[0][1]


def _counts(sheet: Sheet, index: int) -> int | None:
    counts, turns = sheet.number(index, 1), sheet.number(index, 2)
    return round(counts / (turns or 1)) if counts and counts > 1 else None
