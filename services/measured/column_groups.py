"""Groups of columns that belong to one signal, and their units, guessed from names and numbers."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hal.calibration.units import CONVERSIONS, NAMED, PLAIN

BRACKET = re.compile(r"\s*[\[(]([^\])\d][^\])]*)[\])]\s*$")
TAIL = re.compile(
    r"[_\s](deg_per_s|rad_per_s|deg_s|rad_s|m_per_s|degrees|radians|degps|radps|dps|mps2|mps|kmh|kph|deg|rad|nm|nmm|mm|cm"
    r"|rpm|ma|mv|kpa|mpa|bar|degc|px|ms|us|ns)$",
    re.IGNORECASE,
)
"""An end of a name that is a unit."""
LETTER = re.compile(r"[_\s]([nmsva])$", re.IGNORECASE)
"""An end of a name that is a unit if the name also has a word of a quantity or of a source of electricity."""
INDEX = re.compile(r"\d+(?=\D*$)")
AXIS = re.compile(r"^(.*?)(x|y|z|w|roll|pitch|yaw)$", re.IGNORECASE)

WORDS = {
    "torque": "N m",
    "tau": "N m",
    "effort": "N m",
    "force": "N",
    "f": "N",
    "tension": "N",
    "thrust": "N",
    "current": "A",
    "voltage": "V",
    "temperature": "degC",
    "temp": "degC",
    "angle": "rad",
    "theta": "rad",
    "rpy": "rad",
    "q": "rad",
    "gyro": "rad/s",
    "omega": "rad/s",
    "accel": "m/s^2",
    "acceleration": "m/s^2",
    "quaternion": "1",
    "quat": "1",
}
"""A name with one of these words probably has this unit."""
QUANTITIES = {
    *WORDS,
    "pos",
    "position",
    "vel",
    "velocity",
    "length",
    "pressure",
    "strain",
    "pwm",
    "command",
    "cmd",
    "ref",
}
SOURCES = {"battery", "bus", "motor", "supply"}
"""Current and voltage of these are often called by the unit alone: `battery_a`, `battery_v`."""
LARGEST_ANGLE = 6.5
"""An angle beyond this is in degrees [rad]."""
DERIVED = 0.8
"""A column whose correlation with the steps of another is larger than this is the rate of the other."""


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a file.

    Attributes:
        file: File in the folder of an episode; None if the episode is a file.
        label: Its name, or its number as text where the file has no names.
        values: Numbers, shape (rows,), NaN where no number is.
    """

    file: str | None
    label: str
    values: np.ndarray

    @property
    def is_numbered(self) -> bool:
        """Whether the column has no name."""
        return self.label.isdigit()

    @property
    def is_dead(self) -> bool:
        """Whether it never varies or was never measured."""
        known = self.values[np.isfinite(self.values)]
        return not len(known) or bool(np.ptp(known) == 0.0)


@dataclass(frozen=True, slots=True)
class Group:
    """Columns of one signal.

    Attributes:
        name: Name of the signal.
        columns: Its columns in the order of the file.
        unit: Unit of its numbers; None if it is not known.
        is_guess: Whether the unit is not written in the name.
    """

    name: str
    columns: tuple[Column, ...]
    unit: str | None
    is_guess: bool = False


def unit_in(name: str) -> tuple[str, str | None]:
    """Return a name without its unit, and the unit: `angle [deg]`, `angle_deg`."""
    for pattern in (BRACKET, TAIL):
        match = pattern.search(name)
        unit = match and proper(match[1])
        if match and unit:
            return name[: match.start()].strip() or name, unit
    return name, None


def proper(text: str) -> str | None:
    """Return a unit as it is written in a description; None if it is not known."""
    own = next((unit for unit in (*PLAIN, *CONVERSIONS) if text.strip() == unit), None)
    by_case = {unit.lower(): unit for unit in ("mA", "mV", "kPa", "MPa", "degC")}
    return (
        own
        or NAMED.get(text.strip().lower())
        or by_case.get(text.strip().lower())
        or (text.strip().lower() if text.strip().lower() in PLAIN else None)
    )


def grouped(columns: Sequence[Column], stem: str) -> list[Group]:
    """Return the signals that columns probably belong to, in the order of their first columns.

    Args:
        columns: Columns of all files.
        stem: Name for columns without names.
    """
    groups: list[Group] = []
    for file in dict.fromkeys(column.file for column in columns):
        own = [column for column in columns if column.file == file]
        named = [column for column in own if not column.is_numbered]
        plain = [column for column in own if column.is_numbered]
        groups += _by_name(named) + _by_number(plain, re.sub(r"\..*$", "", file) if file else stem)
    groups.sort(key=lambda group: columns.index(group.columns[0]))
    return _distinct(groups)


def _by_name(columns: list[Column]) -> list[Group]:
    remaining, groups = list(columns), []
    rules: tuple[Callable[[str], str | None], ...] = (_index, _axis, _path, _quantity, _first)
    for rule in rules:
        keys: dict[tuple[str, str | None], list[Column]] = {}
        for column in remaining:
            base, unit = unit_in(column.label)
            key = rule(base)
            if key is not None:
                keys.setdefault((key, unit), []).append(column)
        for (key, unit), members in keys.items():
            if len(members) > 1 and not _differ_in_unit(members):
                groups.append(_group(key, members, unit))
                remaining = [column for column in remaining if column not in members]
    for column in remaining:
        base, unit = unit_in(column.label)
        groups.append(_group(re.sub(r"_0$", "", base), [column], unit))
    return groups


def _differ_in_unit(columns: list[Column]) -> bool:
    """Whether the ends of the names are different units: `battery_a`, `battery_v`, but not three phases a, b, c."""
    letters = {match[1].lower() for column in columns if (match := LETTER.search(column.label))}
    return len(letters) == len(columns) and all((QUANTITIES | SOURCES) & set(_words(c.label)) for c in columns)


def _index(name: str) -> str | None:
    return INDEX.sub("#", name, count=1) if INDEX.search(name) else None


def _axis(name: str) -> str | None:
    match = AXIS.match(name)
    if match is None:
        return None
    return f"{match[1]}@" if len(match[2]) == 1 else f"{match[1]}rpy"


def _path(name: str) -> str | None:
    head, mark, _ = name.replace("/", ".").rpartition(".")
    return head.strip(".") or None if mark else None


def _quantity(name: str) -> str | None:
    return next((word for word in _words(name) if word in QUANTITIES), None)


def _first(name: str) -> str | None:
    head, mark, _ = name.partition("_")
    return head if mark and head else None


def _words(name: str) -> list[str]:
    name = re.sub(r"\d[A-Za-z]+\d\w*", "", name)  # a hexadecimal ID: the f in 4F1 is no force
    return [word for word in re.split(r"[^a-z]+", re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower()) if word]


def _group(key: str, columns: list[Column], unit: str | None) -> Group:
    base, own = unit_in(re.sub(r"[_\s.]*[#@]", "", key))
    unit, is_guess = unit or own, False
    words = _words(base)
    if unit is None and (letter := LETTER.search(base)) and (QUANTITIES | SOURCES) & set(words):
        base, unit = base[: letter.start()], proper(letter[1].upper() if letter[1] in "nva" else letter[1])
    if unit is None:
        unit = next((WORDS[word] for word in words if word in WORDS), None) or _of_joint(words)
        is_guess = unit is not None
        largest = max((float(np.nanmax(np.abs(c.values))) for c in columns if not c.is_dead), default=0.0)
        if unit == "rad" and largest > LARGEST_ANGLE:
            unit = "deg"
    name = re.sub(r"\W+", "_", base).strip("_").lower() or "position"
    return Group(name if not name[0].isdigit() else f"signal_{name}", tuple(columns), unit, is_guess)


def _of_joint(words: Sequence[str]) -> str | None:
    """Return the unit of positions and velocities of joints; those of other things may be lengths."""
    if "joint" not in words:
        return None
    return "rad" if {"pos", "position"} & set(words) else "rad/s" if {"vel", "velocity"} & set(words) else None


def _by_number(columns: list[Column], stem: str) -> list[Group]:
    """Return the signals of columns without names: a block and its rate, and the others in blocks of the same size."""
    if not columns:
        return []
    start, size, offset = _rates(columns)
    if not size:
        return [Group(_name(stem), tuple(columns), None)]
    groups = []
    cuts = {start, start + size, start + offset, start + offset + size}
    edges = sorted({0, len(columns), *cuts})
    for first, last in pairwise(edges):
        step = size if (last - first) % size == 0 else last - first
        for begin in range(first, last, step):
            part = tuple(columns[begin : begin + step])
            suffix = "" if begin == start else "_rate" if begin == start + offset else f"_{part[0].label}"
            groups.append(Group(_name(stem) + suffix, part, None))
    return groups


def _rates(columns: list[Column]) -> tuple[int, int, int]:
    """Return the first column and the size of a block, and the offset of the block of its rates; size 0 if none is."""
    rows = np.nan_to_num(np.stack([column.values for column in columns])[:, :4000])
    steps, middle = np.diff(rows, axis=1), 0.5 * (rows[:, 1:] + rows[:, :-1])
    low, high = np.quantile(steps, (0.01, 0.99), axis=1, keepdims=True)
    steps = np.clip(steps, low, high)  # a jump between two episodes is no rate
    both = np.concatenate([steps, middle])
    both = both - both.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(both, axis=1, keepdims=True)
    both = both / np.where(norm > 0.0, norm, np.inf)
    similar = both[: len(columns)] @ both[len(columns) :].T > DERIVED
    best = (0, 0, 0)
    for offset in range(1, len(columns)):
        diagonal = np.diagonal(similar, offset)
        start = 0
        for index in range(len(diagonal) + 1):
            if index == len(diagonal) or not diagonal[index]:
                size = min(index - start, offset)
                best = max(best, (start, size, offset), key=lambda block: block[1])
                start = index + 1
    return best if best[1] > 1 else (0, 0, 0)


def _name(stem: str) -> str:
    name = re.sub(r"\W+", "_", stem).strip("_").lower() or "signal"
    return name if not name[0].isdigit() else f"signal_{name}"


def _distinct(groups: Iterable[Group]) -> list[Group]:
    """Return the groups with names that differ: if two are alike without their units, they keep these."""
    groups = list(groups)
    shared = Counter(group.name for group in groups)
    names: Counter[str] = Counter()
    distinct = []
    for group in groups:
        is_shared = shared[group.name] > 1 and len(group.columns) == 1 and not group.columns[0].is_numbered
        name = _name(group.columns[0].label) if is_shared else group.name
        names[name] += 1
        name = name if names[name] == 1 else f"{name}_{names[name]}"
        distinct.append(Group(name, group.columns, group.unit, group.is_guess))
    return distinct
