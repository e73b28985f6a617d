"""Parts of a drafted robot file: a device, its settings and its elements."""

import re
from dataclasses import dataclass, field
from typing import Any

import yaml

NAME, CAMEL = re.compile(r"[^A-Za-z0-9]+"), re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
STALE_AFTER = 0.06
"""A value of a node that answers each cycle is stale after this time [s], at the drafted rate of 100 Hz."""


@dataclass(frozen=True, slots=True)
class Measure:
    """One element that a device measures or moves.

    Attributes:
        quantity: Quantity of the driver.
        signal: Signal of the robot file.
        element: Element of the signal.
        unit: Unit of the signal.
        stale_after: Age [s] from which a value is stale.
    """

    quantity: str
    signal: str
    element: str
    unit: str
    stale_after: float = STALE_AFTER


@dataclass(frozen=True, slots=True)
class Part:
    """A device and its kind.

    Attributes:
        name: Name of the device; the kind has the same name.
        driver: Driver of `hal.registry`.
        settings: Settings of the kind.
        node: Node id.
        measures: Its elements; the first is the main one.
        origin: File or node that it was drafted from.
        to_set: Settings that the user must replace, in words; empty if the file has all.
        is_drive: Whether it is commanded.
        bus: Number of its bus, from 0; a DBC file with identifiers of another file has one of its own.
        is_fd: Whether it sends frames of CAN FD.
    """

    name: str
    driver: str
    settings: dict[str, Any]
    node: int
    measures: tuple[Measure, ...]
    origin: str
    to_set: str = ""
    is_drive: bool = False
    bus: int = 0
    is_fd: bool = False


def is_text(name: str) -> bool:
    """Whether YAML takes a name without quotes for a text, as it does not with `8` and `on`."""
    return isinstance(yaml.safe_load(name), str)


@dataclass(slots=True)
class Names:
    """Names that were given, so that no two devices have the same one."""

    given: set[str] = field(default_factory=set)

    def new(self, text: str) -> str:
        """Return a name of lower-case letters, digits and underscores, with a number if it was given before."""
        base = NAME.sub("_", CAMEL.sub("_", text)).strip("_").lower() or "node"
        base = base if base[0].isalpha() and is_text(base) else f"node_{base}"
        name, number = base, 2
        while name in self.given:
            name, number = f"{base}_{number}", number + 1
        self.given.add(name)
        return name
