"""Devices drafted from a DBC file: one sensor for each node that sends measured values."""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

from cantools.database import Message
from cantools.database.can.signal import Signal

from hal.calibration.units import CONVERSIONS, NAMED, ROBOT_UNITS
from hal.finding.draft.parts import STALE_AFTER, Measure, Names, Part
from hal.finding.scan import EXTENDED
from hal.protocols.dbc import Dbc, is_fd

COMMAND = re.compile(r"cmd|command|request|set_?point|^set|_set_|target|demand|ctrl|control(?!.*stat)", re.IGNORECASE)
"""A message with such a name is one that the host sends."""
HOST = re.compile(r"^(host|master|driver|pc|controller|tester|vcu|ecu_?host|robot)$", re.IGNORECASE)
"""A node with such a name is the host."""
WORDS = {
    "N": "force",
    "N m": "torque",
    "rad": "angle",
    "rad/s": "turning_rate",
    "m": "distance",
    "m/s": "speed",
    "m/s^2": "acceleration",
    "degC": "temperature",
    "V": "voltage",
    "A": "current",
    "Pa": "pressure",
    "kg": "mass",
    "W": "power",
    "Hz": "frequency",
    "%": "percentage",
    "1": "value",
}
"""Signals of a robot file are named by their units."""
MORE_UNITS = {"rev/s": ("rad/s", 2.0 * math.pi), "rps": ("rad/s", 2.0 * math.pi), "km/h": ("m/s", 1.0 / 3.6)}
CELSIUS = ("c", "°c", "deg c", "degc", "celsius")
NO_VALUE = re.compile(
    r"count|crc|check|alive|rolling|mux|serial|version|reserved|spare|state|status|flag|fault|err|mode", re.I
)
"""A signal without a unit and with such a name is not a measured value."""
PERIOD = 0.1
"""A message has this period [s] if the file does not state one."""
STALE_PERIODS = 4
"""A value is stale after this number of periods."""
SHORTEST = 8
"""A value without a unit has at least this number of bits."""
MOST_SIGNALS, FEWEST_SIGNALS, MOST_OF_FILE = 24, 3, 64
"""At most 24 signals of a node are drafted; fewer, but at least three, of nodes that have more than 64 together."""
ODRIVE = {"Set_Axis_State", "Get_Encoder_Estimates", "Set_Input_Pos", "Heartbeat"}
"""A file with all of these messages describes an ODrive."""


def unit_of(text: str | None) -> tuple[str, float] | None:
    """Return the SI unit of a unit in a DBC file, and its factor; None if the unit is not known or there is none."""
    plain = (text or "").strip()
    unit = "degC" if plain.lower() in CELSIUS else NAMED.get(plain.lower(), plain)
    if unit in CONVERSIONS or unit in MORE_UNITS:
        return CONVERSIONS.get(unit) or MORE_UNITS[unit]
    return (unit, 1.0) if unit in ROBOT_UNITS and unit != "1" else None


def measured(message: Message) -> list[Signal]:
    """Return the signals of a message that are measured values: those in a known unit, or else those without one."""
    signals = [signal for signal in message.signals if not signal.is_multiplexer]
    known = [signal for signal in signals if unit_of(signal.unit)]
    return known or [signal for signal in signals if signal.length >= SHORTEST and not NO_VALUE.search(signal.name)]


def is_odrive(file: Dbc) -> bool:
    """Whether a file describes the axes of an ODrive."""
    return {message.name for message in file.messages} >= ODRIVE


def identifiers_of(file: Dbc) -> set[int]:
    """Return the identifiers of all messages, as a scan has them."""
    return {_key(message) for message in file.messages}


def nodes_of(file: Dbc) -> set[int]:
    """Return the node ids that a CANopen device cannot have, because the file uses identifiers that would be its."""
    return {message.frame_id & 0x7F for message in file.messages if not message.is_extended_frame}


def odrive_part(dbc: str, names: Names, node: int, origin: str, signal: str, name: str = "axis") -> Part:
    """Return an axis of an ODrive, whose position is in `signal`."""
    own = names.new(name)
    measure = Measure("position", signal, own, "rad")
    return Part(own, "odrive", {"dbc": dbc, "gear": 1.0}, node, (measure,), origin, "gear", is_drive=True)


def parts_of(
    file: Dbc, dbc: str, names: Names, node: int, notes: list[str], rates: Mapping[int, float] | None = None
) -> list[Part]:
    """Return one sensor for each node of the file that sends measured values.

    Args:
        file: The DBC file.
        dbc: Its path as the robot file has it.
        names: Names that were given.
        node: Node id of the first one.
        notes: Sentences on what was left out are appended.
        rates: Identifier on a bus, as in `Scan.unknown` -> frames per second [Hz]; only messages that are there are
            used, with these rates.
    """
    own: dict[str, list[Message]] = {}
    commands, without = [], []
    for message in file.messages:
        sender = next(iter(message.senders), "") or ""
        if rates is not None and not rates.get(_key(message), 0.0):
            continue
        if HOST.search(sender) or COMMAND.search(message.name):
            commands.append(message.name)
        elif not measured(message):
            without.append(message.name)
        else:
            own.setdefault(sender if not sender.startswith("Vector__") else "", []).append(message)
    most = min(MOST_SIGNALS, max(FEWEST_SIGNALS, MOST_OF_FILE // max(len(own), 1)))
    parts = [_part(file, dbc, sender, messages, names, node + number, rates, notes, most)
             for number, (sender, messages) in enumerate(own.items())]  # fmt: skip
    count = sum(len(list(_signals(messages))) for messages in own.values())
    drafted = sum(len(part.measures) for part in parts)
    if drafted < count:
        notes.append(f"'{file.path.name}': {count - drafted} of {count} signals left out; add those you need.")
    if file.left_out:
        notes.append(
            f"'{file.path.name}': {_listed(list(file.left_out))} left out, which cannot be used. The first one: "
            f"{next(iter(file.left_out.values()))}"
        )
    if commands:
        notes.append(
            f"'{file.path.name}': the host sends {_listed(commands)}. If a node is a servo, describe it as `dbc_servo` "
            "(docs/devices.md)."
        )
    if without:
        notes.append(f"'{file.path.name}': {_listed(without)} left out, because no signal is a measured value.")
    return parts


def _part(
    file: Dbc,
    dbc: str,
    sender: str,
    messages: list[Message],
    names: Names,
    node: int,
    rates: Mapping[int, float] | None,
    notes: list[str],
    most: int,
) -> Part:
    name = names.new(sender if len(sender) > 3 else file.path.stem)
    chosen = sorted(_signals(messages), key=lambda pair: unit_of(pair[1].unit) is None)[:most]
    used = [message for message in messages if any(message is one for one, _ in chosen)]
    periods = {message.name: _period(message, rates) for message in used}
    unknown = [message.name for message in used if rates is None and not message.cycle_time]
    plain = [signal.name for _, signal in chosen if not unit_of(signal.unit)]
    if plain:
        notes.append(f"'{file.path.name}': {_listed(plain)} have no unit that is known, so their unit is 1.")
    quantities, measures, given = {}, [], Names()
    for message, signal in chosen:
        unit, factor = unit_of(signal.unit) or ("1", 1.0)
        quantity = given.new(signal.name)
        quantities[quantity] = {"signal": f"{message.name}.{signal.name}"} | (
            {} if factor == 1.0 else {"scale": factor}
        )
        word = WORDS.get(unit) or "value_" + re.sub(r"\W+", "_", unit)
        stale = max(STALE_AFTER, STALE_PERIODS * periods[message.name])
        measures.append(Measure(quantity, word, f"{name}_{quantity}", unit, round(stale, 3)))
    settings: dict[str, Any] = {"dbc": dbc, "periods": periods, "quantities": quantities}
    slowest = max(periods.values())
    if slowest > 0.02:
        settings["silent_after"] = round(2 * STALE_PERIODS * slowest, 3)
    to_set = f"period of {_listed(unknown)}" if unknown else ""
    fd = any(is_fd(message) for message in used)
    return Part(name, "dbc", settings, node, tuple(measures), file.path.name, to_set, is_fd=fd)


def _signals(messages: list[Message]) -> Iterator[tuple[Message, Signal]]:
    for message in messages:
        for signal in measured(message):
            yield message, signal


def _period(message: Message, rates: Mapping[int, float] | None) -> float:
    """Return the period of a message [s]: measured on a bus, or stated by the file."""
    if rates is not None:
        return float(f"{1.0 / rates[_key(message)]:.2g}")
    return message.cycle_time / 1000.0 if message.cycle_time else PERIOD


def _key(message: Message) -> int:
    """Return the identifier of a message as a scan has it."""
    return message.frame_id | (EXTENDED if message.is_extended_frame else 0)


def _listed(names: list[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
