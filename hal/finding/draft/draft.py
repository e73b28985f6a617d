"""A whole draft: from a folder with the files of vendors, or from a scanned bus and such a folder."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from hal.config import BusConfig
from hal.errors import ConfigError
from hal.finding.draft import dbc_parts, sheets
from hal.finding.draft.parts import Measure, Names, Part
from hal.finding.draft.servo_parts import servo_part
from hal.finding.draft.sheets import FIRST_NODES, PROFILES, Sheet
from hal.finding.draft.text import robot_text
from hal.finding.scan import Node, Scan
from hal.protocols import cia301, dbc

STAND_IN = "stand_in"
LARGEST_NODE = 127
FUNCTIONS = (0x080, *range(0x180, 0x600, 0x080), 0x600, 0x700)
"""The identifiers of a CANopen device are these numbers plus its node id."""
SUFFIXES = (".eds", ".dcf", ".dbc")
DEPTH = 3
"""Files are looked for at most this many folders deep."""
SHIPPED = {402: "servo_drive", 406: "joint_encoder", 404: "load_cell", 401: "analog_input"}
"""EDS files of this package, by device profile."""
ODRIVE = "odrive_cansimple.dbc"
DATA_BITRATE = 2_000_000
"""A bus with frames of CAN FD has this bit rate of their data [bit/s] until the user sets it."""


@dataclass(frozen=True, slots=True)
class Draft:
    """A robot file that is not written yet.

    Attributes:
        robot: Name of the robot.
        text: The robot file.
        copies: Path from its folder -> file of this package to copy there.
        summary: Sentence on the devices.
        notes: Sentences on what was left out or guessed.
    """

    robot: str
    text: str
    copies: Mapping[str, Path]
    summary: str
    notes: tuple[str, ...]


@dataclass(slots=True)
class _Draughtsman:
    """Files of a folder, and the parts drafted so far."""

    folder: Path
    shipped: Path
    names: Names = field(default_factory=Names)
    notes: list[str] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    copies: dict[str, Path] = field(default_factory=dict)
    nodes: set[int] = field(default_factory=set)
    identifiers: list[set[int]] = field(default_factory=lambda: [{cia301.NMT, cia301.SYNC}])
    """Identifiers that are taken, by bus."""
    has_encoders: bool = False
    waiting: int = 1
    """Number of CANopen devices without a node id yet; a drive that stands in may be one."""

    @property
    def moved(self) -> str:
        """Signal of the drives: motors if encoders measure the joints."""
        return "motor_position" if self.has_encoders else "joint_position"

    def path_of(self, path: Path) -> str:
        """Return the path of a file from the folder of the robot file."""
        return Path(os.path.relpath(path.resolve(), self.folder.resolve())).as_posix()

    def copy(self, kind: str, name: str) -> str:
        """Note a file of this package to be copied beside the robot file; return its path there."""
        self.copies[f"{kind}/{name}"] = self.shipped / kind / name
        return f"{kind}/{name}"

    def without_copies(self, files: Sequence[Path], source: Path) -> list[Path]:
        """Return files of a folder without those that an earlier draft copied beside its robot file: no own devices.

        Files that lie in the folder itself, and not deeper, are the user's.
        """
        drafts = [file.read_text(errors="replace") for file in self.folder.glob("*.yaml")]
        own = []
        for path in files:
            place = self.path_of(path)
            original = self.shipped / place
            is_same = original.is_file() and original.read_bytes() == path.read_bytes()
            if is_same and path.parent != source and any(place in draft for draft in drafts):
                self.notes.append(f"Left out: '{place}' was copied there by an earlier draft.")
            else:
                own.append(path)
        return own

    def node(self, wish: int | None, first: int) -> int:
        """Return a node id that no other device has: the wished one, or the next from `first` on.

        Without a free one it is `first`, and `gemuco doctor` names the two devices.
        """
        wishes = (wish or first, *range(first, LARGEST_NODE + 1), *range(1, first))
        node = next((node for node in wishes if node not in self.nodes), first)
        self.nodes.add(node)
        return node

    def add_stand_in(self) -> None:
        """Add a drive if there is none, because a robot commands at least one element."""
        if any(part.is_drive for part in self.parts):
            return
        settings = {"eds": self.copy("eds", "servo_drive.eds"), "counts_per_turn": 4096, "gear": 1.0}
        measure = Measure("position", self.moved, STAND_IN, "rad")
        node = self.node(None, FIRST_NODES[402])
        self.parts.append(
            Part(STAND_IN, "cia402", settings, node, (measure,), "no drive was there", "your drive", is_drive=True)
        )
        self.notes.append(
            f"There is no drive, and a robot needs one: '{STAND_IN}' takes its place until you set yours."
        )


def draft_folder(source: Path, name: str, folder: Path, shipped: Path) -> Draft:
    """Return a robot file with one device for each EDS or DCF file, and one for each sending node of a DBC file.

    Args:
        source: Folder with the files of vendors.
        name: Name of the robot.
        folder: Folder of the robot file.
        shipped: Folder of the robot files of this package.

    Raises:
        ConfigError: There is no such file, or none that can be used.
    """
    files = files_in(source)
    if not files:
        raise ConfigError(
            f"'{source}' has no EDS, DCF or DBC file. Give the folder with the files of your devices, or a URDF or "
            "MJCF file."
        )
    work = _Draughtsman(folder, shipped)
    own = work.without_copies(files, source)
    known = list(_sheets(own, work.notes))
    work.has_encoders = any(sheet.profile == 406 for sheet in known)
    work.waiting += sum(not sheet.node for sheet in known)
    _add_sheets(work, [sheet for sheet in known if sheet.node])
    for path in own:  # before those without a node id, because the identifiers of a DBC file are not free to choose
        if path.suffix.lower() == ".dbc":
            _add_dbc(work, path, None)
    _add_sheets(work, [sheet for sheet in known if not sheet.node])
    if not work.parts:
        raise ConfigError(f"None of {len(files)} files in '{source}' can be used. {' '.join(work.notes)}")
    work.add_stand_in()
    count = f"{len(own)} file{'s' if len(own) > 1 else ''}"
    real = "interface: socketcan, channel: can0. Node ids are guessed: `gemuco scan` lists them."
    return _finished(work, name, f"{count} in {source}", "can0", real, BusConfig(channel="can0"))


def draft_bus(
    result: Scan, channel: str, rates: BusConfig, source: Path | None, name: str, folder: Path, shipped: Path
) -> Draft:
    """Return a robot file with one device for each node of a bus that a driver fits.

    Args:
        result: The scan.
        channel: Interface and channel, as YAML.
        rates: A bus with the bit rates of the scanned one.
        source: Folder with the files of vendors; None: EDS files of this package take their place.
        name: Name of the robot.
        folder: Folder of the robot file.
        shipped: Folder of the robot files of this package.

    Raises:
        ConfigError: There is no node with a driver.
    """
    work = _Draughtsman(folder, shipped)
    files = files_in(source) if source else []
    known = list(_sheets(files, work.notes))
    work.has_encoders = any(node.profile == 406 for node in result.nodes)
    if result.silence:
        work.notes.append(result.silence)
    for node in result.nodes:
        _add_node(work, node, known)
    for path in files:
        if path.suffix.lower() == ".dbc":
            _add_dbc(work, path, result)
    if not work.parts:
        raise ConfigError(
            f"No node on {result.bus} has a driver ({len(result.nodes)} nodes, {len(result.unknown)} other "
            f"identifiers). Are they powered, is the bit rate {rates.bitrate}? {' '.join(work.notes)}".rstrip()
        )
    work.add_stand_in()
    return _finished(work, name, f"the nodes on {result.bus}", result.bus, channel, rates)


def files_in(folder: Path) -> list[Path]:
    """Return the EDS, DCF and DBC files in a folder and its folders, sorted.

    Raises:
        ConfigError: There is no such folder.
    """
    if not folder.is_dir():
        raise ConfigError(f"There is no folder '{folder}'. Is its path right?")
    files = [
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in SUFFIXES and len(path.relative_to(folder).parts) <= DEPTH and path.is_file()
    ]
    return sorted(files)


def _sheets(files: Sequence[Path], notes: list[str]) -> Iterator[Sheet]:
    """Yield the EDS and DCF files with a driver; a note says why one is left out."""
    for path in files:
        if path.suffix.lower() == ".dbc":
            continue
        try:
            sheet = sheets.read(path)
        except ConfigError as error:
            notes.append(f"Left out: {error}")
            continue
        if sheet.profile in PROFILES:
            yield sheet
        else:
            drivers = ", ".join(f"{number} ({word})" for number, word in PROFILES.items())
            notes.append(
                f"Left out: '{path.name}' has device profile {sheet.profile}; there are drivers for {drivers}."
            )


def _add_sheets(work: _Draughtsman, known: Sequence[Sheet]) -> None:
    for sheet in known:
        node = work.node(sheet.node, FIRST_NODES[sheet.profile])
        work.identifiers[0] |= {function + node for function in FUNCTIONS}
        work.parts.append(sheets.part_of(sheet, work.path_of(sheet.path), work.names, node, work.moved))


def _add_dbc(work: _Draughtsman, path: Path, result: Scan | None) -> None:
    try:
        file = dbc.load(path)
    except ConfigError as error:
        work.notes.append(f"Left out: {' '.join(str(error).split())}")
        return
    own = work.path_of(path)
    if dbc_parts.is_odrive(file):
        if result is None:
            work.parts.append(dbc_parts.odrive_part(own, work.names, work.node(None, 3), path.name, work.moved))
        return
    rates = None if result is None else result.unknown
    parts = dbc_parts.parts_of(file, own, work.names, work.node(None, 91), work.notes, rates)
    bus = _bus_of(work, file) if result is None else 0
    if bus:
        work.notes.append(f"'{path.name}' has identifiers of another file, so it is on another bus.")
    work.nodes |= {part.node for part in parts} | (set() if bus else dbc_parts.nodes_of(file))
    work.parts += [replace(part, bus=bus) for part in parts]
    if not parts:
        where = "" if result is None else f" that was received on {result.bus}"
        work.notes.append(f"Left out: no message of '{path.name}'{where} has a measured value.")


def _bus_of(work: _Draughtsman, file: dbc.Dbc) -> int:
    """Return the first bus on which all identifiers of a DBC file are free, and take them.

    Beside it the first bus must have room for the CANopen devices whose node ids are not chosen yet.
    """
    own = dbc_parts.identifiers_of(file)
    has_room = len(work.nodes | dbc_parts.nodes_of(file) - {0}) + work.waiting <= LARGEST_NODE
    fitting = (bus for bus, taken in enumerate(work.identifiers) if not taken & own and (bus > 0 or has_room))
    bus = next(fitting, len(work.identifiers))
    if bus == len(work.identifiers):
        work.identifiers.append(set())
    work.identifiers[bus] |= own
    return bus


def _add_node(work: _Draughtsman, node: Node, known: Sequence[Sheet]) -> None:
    if node.protocol == "ODrive":
        path = work.copy("dbc", ODRIVE)
        work.nodes.add(node.node)
        work.parts.append(
            dbc_parts.odrive_part(
                path, work.names, node.node, f"ODrive, node {node.node}", work.moved, f"axis_{node.node}"
            )
        )
        return
    if node.protocol in ("Feetech", "Dynamixel"):
        if (servo := servo_part(node, work.names, work.notes)) is not None:
            work.nodes.add(node.node)
            work.parts.append(servo)
        return
    label = f"node {node.node}" + (f" '{node.text(0x1008)}'" if node.text(0x1008) else "")
    if node.protocol == "MIT":
        work.notes.append(f"Left out: {label} is a drive in MIT mode, whose motor must be known (docs/devices.md).")
        return
    profile = node.profile
    if profile not in PROFILES:
        what = f"is a {node.kind}" if node.kind else "did not state its profile"
        work.notes.append(f"Left out: {label} {what}; there are drivers for {', '.join(map(str, PROFILES))}.")
        return
    vendor, product = node.number(0x1018, 1), node.number(0x1018, 2)
    fitting = [sheet for sheet in known if sheet.profile == profile]
    same = [sheet for sheet in fitting if (sheet.vendor, sheet.product) == (vendor, product)]
    if same or fitting:
        sheet = (same or fitting)[0]
        path = work.path_of(sheet.path)
        if not same:
            work.notes.append(f"'{sheet.path.name}' is taken for {label} by its profile; its identity is another one.")
    else:
        path = work.copy("eds", f"{SHIPPED[profile]}.eds")
        sheet = sheets.read(work.copies[path])
        work.notes.append(f"{label} has a general EDS file in place of its vendor's. Replace {path}.")
    work.nodes.add(node.node)
    name = f"{PROFILES[profile]}_{node.node}"
    part = sheets.part_of(sheet, path, work.names, node.node, work.moved, name)
    work.parts.append(part)


def _finished(work: _Draughtsman, name: str, source: str, bus: str, real: str, rates: BusConfig) -> Draft:
    parts = work.parts
    if rates.data_bitrate is None and (files := {part.origin: None for part in parts if part.is_fd}):
        rates = rates.model_copy(update={"data_bitrate": DATA_BITRATE})
        work.notes.append(f"{', '.join(files)}: frames of CAN FD. Set data_bitrate to the bit rate of their data.")
    text = robot_text(name, source, bus, real, rates, parts, work.notes)
    drives = sum(part.is_drive for part in parts)
    to_set = sum(bool(part.to_set) for part in parts)
    summary = (
        f"devices: {len(parts)}, of them drives: {drives}, elements: {sum(len(part.measures) for part in parts)}; "
        f"lines to set: {to_set + 1}."
    )
    return Draft(name, text, work.copies, summary, tuple(work.notes))
