"""Write the electronic data sheets of the simulated nodes: `python robots/eds/write_eds.py`.

The tables below are the readable form of servo_drive.eds (CiA 402), load_cell.eds (CiA 404), analog_input.eds (CiA 401)
and joint_encoder.eds (CiA 406). The vendor is invented: 0x47454D55 is "GEMU", and is not registered with CAN in
Automation.
"""

from dataclasses import dataclass, replace
from pathlib import Path

VENDOR, VENDOR_NAME = 0x47454D55, "gemuco (simulated, not a registered vendor)"
REVISION = 0x00010000

BOOL, I8, I16, I32, U8, U16, U32, F32, STRING = 1, 2, 3, 4, 5, 6, 7, 8, 9
RPDO, TPDO = "rpdo", "tpdo"

VARIABLE, ARRAY, RECORD = 7, 8, 9
MANDATORY = (0x1000, 0x1001, 0x1018)


@dataclass(frozen=True)
class Entry:
    """One value: what a sub-index holds; `access` of a value that fits in a PDO is rw, ro, wo, rwr or rww."""

    name: str
    kind: int
    access: str
    default: int | float | str = 0
    pdo: bool = False
    low: int | None = None
    high: int | None = None


@dataclass(frozen=True)
class Object:
    """One index: a variable, or an array or record whose entries start at sub-index 0."""

    index: int
    name: str
    shape: int
    entries: tuple[Entry, ...]


def variable(index: int, entry: Entry) -> Object:
    """An object without sub-indices."""
    return Object(index, entry.name, VARIABLE, (entry,))


def array(index: int, entry: Entry, count: int = 1, first: Entry | None = None) -> Object:
    """Values of one type, all with the same default."""
    head = first or Entry("Highest sub-index supported", U8, "const", count)
    items = tuple(replace(entry, name=f"{entry.name} {sub}") for sub in range(1, count + 1))
    return Object(index, entry.name, ARRAY, (head, *items))


def record(index: int, name: str, *entries: Entry) -> Object:
    """Values of different types."""
    return Object(index, name, RECORD, (Entry("Highest sub-index supported", U8, "const", len(entries)), *entries))


def pdo(direction: str, number: int, cob: int, mapping: tuple[int, ...] = (), transmission: int = 1) -> list[Object]:
    """Communication and mapping objects of one PDO; without a mapping it is switched off (bit 31)."""
    base, label = (0x1400, "RPDO") if direction == RPDO else (0x1800, "TPDO")
    flags = (0 if mapping else 1 << 31) | (1 << 30 if direction == TPDO else 0)
    timing = [
        Entry("COB-ID", U32, "rw", f"$NODEID+0x{flags | cob:08X}"),
        Entry("Transmission type", U8, "rw", transmission),
        Entry("Inhibit time", U16, "rw"),
        Entry("Compatibility entry", U8, "ro"),
        Entry("Event timer", U16, "rw"),
    ]
    filled = (*mapping, *(0,) * (8 - len(mapping)))
    entries = [Entry(f"Mapped object {sub}", U32, "rw", value) for sub, value in enumerate(filled, 1)]
    return [
        record(base + number, f"{label} {number + 1} communication", *timing[: 5 if direction == TPDO else 2]),
        Object(
            base + 0x200 + number,
            f"{label} {number + 1} mapping",
            RECORD,
            (Entry("Number of mapped objects", U8, "rw", len(mapping), low=0, high=8), *entries),
        ),
    ]


def communication(device_type: int, product: int, name: str) -> list[Object]:
    """Objects that every node has (CiA 301)."""
    return [
        variable(0x1000, Entry("Device type", U32, "const", device_type)),
        variable(0x1001, Entry("Error register", U8, "ro", pdo=True)),
        array(0x1003, Entry("Standard error field", U32, "ro"), 8, Entry("Number of errors", U8, "rw", low=0, high=0)),
        variable(0x1005, Entry("COB-ID SYNC message", U32, "const", 0x80)),
        variable(0x1008, Entry("Manufacturer device name", STRING, "const", name)),
        variable(0x1009, Entry("Manufacturer hardware version", STRING, "const", "simulated")),
        variable(0x100A, Entry("Manufacturer software version", STRING, "const", "1.0")),
        variable(0x1014, Entry("COB-ID EMCY", U32, "const", "$NODEID+0x80")),
        array(0x1016, Entry("Consumer heartbeat time", U32, "rw"), 2),
        variable(0x1017, Entry("Producer heartbeat time", U16, "rw")),
        record(
            0x1018,
            "Identity object",
            Entry("Vendor-ID", U32, "const", VENDOR),
            Entry("Product code", U32, "const", product),
            Entry("Revision number", U32, "const", REVISION),
            Entry("Serial number", U32, "ro"),
        ),
        record(0x1029, "Error behaviour", Entry("Communication error", U8, "rw", low=0, high=2)),
        record(
            0x1200,
            "SDO server parameter",
            Entry("COB-ID client to server", U32, "const", "$NODEID+0x600"),
            Entry("COB-ID server to client", U32, "const", "$NODEID+0x580"),
        ),
        variable(0x2000, Entry("Label", STRING, "rw", "unnamed")),
    ]


def limits(index: int, name: str) -> Object:
    """A pair of INTEGER32 bounds that exclude nothing."""
    return record(index, name, Entry("Minimum", I32, "rw", -(2**31)), Entry("Maximum", I32, "rw", 2**31 - 1))


def ratio(index: int, name: str, above: str, below: str, value: int) -> Object:
    """A ratio of two positive integers."""
    return record(index, name, Entry(above, U32, "rw", value, low=1), Entry(below, U32, "rw", 1, low=1))


SERVO_DRIVE = [
    *communication(0x00020192, 0x402, "gemuco servo drive"),
    *pdo(RPDO, 0, 0x200, (0x60400010, 0x607A0020)),
    *(entry for number in (1, 2, 3) for entry in pdo(RPDO, number, 0x200 + 0x100 * number)),
    *pdo(TPDO, 0, 0x180, (0x60410010, 0x60640020, 0x60770010)),
    *(entry for number in (1, 2, 3) for entry in pdo(TPDO, number, 0x180 + 0x100 * number)),
    array(0x2200, Entry("Temperature of the winding, 0.1 degrees", I16, "ro", 250, pdo=True)),
    variable(0x6007, Entry("Abort connection option code", I16, "rw", 1, low=0, high=3)),
    variable(0x603F, Entry("Error code", U16, "ro", pdo=True)),
    variable(0x6040, Entry("Controlword", U16, "rww", pdo=True)),
    variable(0x6041, Entry("Statusword", U16, "ro", pdo=True)),
    variable(0x605A, Entry("Quick stop option code", I16, "rw", 2, low=0, high=8)),
    variable(0x605B, Entry("Shutdown option code", I16, "rw", 0, low=0, high=1)),
    variable(0x605C, Entry("Disable operation option code", I16, "rw", 1, low=0, high=1)),
    variable(0x605E, Entry("Fault reaction option code", I16, "rw", 2, low=0, high=4)),
    variable(0x6060, Entry("Modes of operation", I8, "rww", 0, pdo=True, low=0, high=10)),
    variable(0x6061, Entry("Modes of operation display", I8, "ro", pdo=True)),
    variable(0x6062, Entry("Position demand value", I32, "ro", pdo=True)),
    variable(0x6064, Entry("Position actual value", I32, "ro", pdo=True)),
    variable(0x6065, Entry("Following error window", U32, "rw", 2**32 - 1)),
    variable(0x6066, Entry("Following error time out", U16, "rw", 20)),
    variable(0x606C, Entry("Velocity actual value", I32, "ro", pdo=True)),
    variable(0x6071, Entry("Target torque", I16, "rww", pdo=True)),
    variable(0x6072, Entry("Max torque", U16, "rww", 3000, pdo=True)),
    variable(0x6076, Entry("Motor rated torque", U32, "rw", 100)),
    variable(0x6077, Entry("Torque actual value", I16, "ro", pdo=True)),
    variable(0x607A, Entry("Target position", I32, "rww", pdo=True)),
    variable(0x607C, Entry("Home offset", I32, "rw")),
    limits(0x607D, "Software position limit"),
    variable(0x607F, Entry("Max profile velocity", U32, "rw", 2**31 - 1)),
    variable(0x6080, Entry("Max motor speed", U32, "rw", 10_000)),
    variable(0x6081, Entry("Profile velocity", U32, "rw", 100_000)),
    variable(0x6083, Entry("Profile acceleration", U32, "rw", 1_000_000, low=1)),
    variable(0x6084, Entry("Profile deceleration", U32, "rw", 1_000_000, low=1)),
    variable(0x6085, Entry("Quick stop deceleration", U32, "rw", 10_000_000, low=1)),
    ratio(0x608F, "Position encoder resolution", "Encoder increments", "Motor revolutions", 4096),
    ratio(0x6091, "Gear ratio", "Motor revolutions", "Shaft revolutions", 29),
    variable(0x6098, Entry("Homing method", I8, "rw", 0)),
    record(
        0x6099,
        "Homing speeds",
        Entry("Speed during search for switch", U32, "rw", 20_000, low=1),
        Entry("Speed during search for zero", U32, "rw", 4_000, low=1),
    ),
    variable(0x609A, Entry("Homing acceleration", U32, "rw", 1_000_000, low=1)),
    variable(0x60A9, Entry("SI unit velocity", U32, "ro", 0x00B50300)),
    variable(0x60C0, Entry("Interpolation sub mode select", I16, "rw", 0, low=0, high=0)),
    array(0x60C1, Entry("Interpolation data record", I32, "rww", pdo=True)),
    record(
        0x60C2,
        "Interpolation time period",
        Entry("Interpolation time period value", U8, "rw", 5),
        Entry("Interpolation time index", I8, "rw", -3, low=-6, high=0),
    ),
    variable(0x60F4, Entry("Following error actual value", I32, "ro", pdo=True)),
    variable(0x60FD, Entry("Digital inputs", U32, "ro", pdo=True)),
    variable(0x60FF, Entry("Target velocity", I32, "rww", pdo=True)),
    variable(0x6502, Entry("Supported drive modes", U32, "ro", 0x3E1)),
]

CHANNELS = 4
"""Of a measuring amplifier."""

LOAD_CELL = [
    *communication(0x00020194, 0x404, "gemuco load cell"),
    *pdo(TPDO, 0, 0x180, (0x91300120, 0x61500108)),
    *(entry for number in (1, 2, 3) for entry in pdo(TPDO, number, 0x180 + 0x100 * number)),
    *(
        array(index, entry, CHANNELS)
        for index, entry in (
            (0x6110, Entry("AI sensor type", U16, "rw", 10_000)),
            (0x6112, Entry("AI operating mode", U8, "rw", 1, low=0, high=1)),
            (0x6114, Entry("AI ADC sample rate", U32, "ro", 500)),
            (0x6124, Entry("AI input offset", F32, "rw", 0.0)),
            (0x6125, Entry("AI autozero", U32, "wo")),
            (0x6126, Entry("AI input scaling factor", F32, "rw", 1.0)),
            (0x6127, Entry("AI input scaling offset", F32, "rw", 0.0)),
            (0x6130, Entry("AI input PV", F32, "ro", 0.0, pdo=True)),
            (0x6131, Entry("AI physical unit PV", U32, "ro", 0x00210000)),
            (0x6132, Entry("AI decimal digits PV", U8, "rw", 2, low=0, high=6)),
            (0x6150, Entry("AI status", U8, "ro", pdo=True)),
            (0x7100, Entry("AI input FV 16 bit", I16, "ro", pdo=True)),
            (0x7130, Entry("AI input PV 16 bit", I16, "ro", pdo=True)),
            (0x9100, Entry("AI input FV 32 bit", I32, "ro", pdo=True)),
            (0x9130, Entry("AI input PV 32 bit", I32, "ro", pdo=True)),
        )
    ),
]

ANALOG_INPUT = [
    *communication(0x00040191, 0x401, "gemuco analog input"),
    *pdo(TPDO, 0, 0x180),
    *pdo(TPDO, 1, 0x280, (0x64010110, 0x64010210, 0x64010310, 0x64010410), transmission=255),
    *pdo(TPDO, 2, 0x380),
    *pdo(TPDO, 3, 0x480),
    variable(0x2120, Entry("Amplifier status", U16, "ro", pdo=True)),
    array(0x6401, Entry("Read analog input 16 bit", I16, "ro", pdo=True), CHANNELS),
    array(0x6402, Entry("Read analog input 32 bit", I32, "ro", pdo=True), CHANNELS),
    array(0x6403, Entry("Read analog input float", F32, "ro", 0.0, pdo=True), CHANNELS),
    variable(0x6423, Entry("Analog input global interrupt enable", BOOL, "rw", 0)),
]

JOINT_ENCODER = [
    *communication(0x00010196, 0x406, "gemuco joint encoder"),
    *pdo(TPDO, 0, 0x180, (0x60040020, 0x65030010)),
    *pdo(TPDO, 1, 0x280),
    variable(0x6000, Entry("Operating parameters", U16, "rw", 0, low=0, high=5)),
    variable(0x6001, Entry("Measuring units per revolution", U32, "rw", 262_144, low=1)),
    variable(0x6002, Entry("Total measuring range in measuring units", U32, "rw", 262_144, low=1)),
    variable(0x6003, Entry("Preset value", U32, "rw")),
    variable(0x6004, Entry("Position value", U32, "ro", pdo=True)),
    array(0x6030, Entry("Speed value", I16, "ro", pdo=True)),
    record(
        0x6031,
        "Speed parameter",
        Entry("Speed source selector", U8, "ro", 1),
        Entry("Speed integration value", U16, "rw"),
        Entry("Multiplier value", U16, "rw", 1, low=1),
        Entry("Divider value", U16, "rw", 1, low=1),
    ),
    variable(0x6500, Entry("Operating status", U16, "ro", pdo=True)),
    variable(0x6501, Entry("Single-turn resolution", U32, "ro", 262_144)),
    variable(0x6502, Entry("Number of distinguishable revolutions", U16, "ro", 1)),
    variable(0x6503, Entry("Alarms", U16, "ro", pdo=True)),
    variable(0x6504, Entry("Supported alarms", U16, "ro", 1)),
    variable(0x6505, Entry("Warnings", U16, "ro", pdo=True)),
    variable(0x6506, Entry("Supported warnings", U16, "ro", 0x10)),
    variable(0x6507, Entry("Profile and software version", U32, "ro", 0x0100_0400)),
    variable(0x6509, Entry("Offset value", I32, "ro")),
    variable(0x650B, Entry("Serial number", U32, "ro")),
]

SHEETS = {
    "servo_drive": (SERVO_DRIVE, 0x402, "CiA 402 servo drive, profile position and cyclic synchronous modes"),
    "load_cell": (LOAD_CELL, 0x404, "CiA 404 load cell amplifier, four channels"),
    "analog_input": (ANALOG_INPUT, 0x401, "CiA 401 analogue inputs, four channels"),
    "joint_encoder": (JOINT_ENCODER, 0x406, "CiA 406 absolute joint encoder"),
}

_BITS = {BOOL: 8, I8: 8, I16: 16, I32: 32, U8: 8, U16: 16, U32: 32}


def sheet(name: str) -> str:
    """Text of one electronic data sheet (CiA 306)."""
    objects, product, description = SHEETS[name]
    sections = [
        _section(
            "FileInfo",
            FileName=f"{name}.eds",
            FileVersion=1,
            FileRevision=0,
            EDSVersion="4.0",
            Description=description,
            CreationTime="12:00AM",
            CreationDate="01-01-2026",
            CreatedBy="gemuco",
            ModificationTime="12:00AM",
            ModificationDate="01-01-2026",
            ModifiedBy="gemuco",
        ),
        _section(
            "DeviceInfo",
            VendorName=VENDOR_NAME,
            VendorNumber=f"0x{VENDOR:08X}",
            ProductName=objects[4].entries[0].default,
            ProductNumber=f"0x{product:08X}",
            RevisionNumber=f"0x{REVISION:08X}",
            OrderCode=name,
            **{f"BaudRate_{rate}": int(rate == 1000) for rate in (10, 20, 50, 125, 250, 500, 800, 1000)},
            SimpleBootUpMaster=0,
            SimpleBootUpSlave=1,
            Granularity=8,
            DynamicChannelsSupported=0,
            GroupMessaging=0,
            NrOfRXPDO=sum(0x1400 <= o.index < 0x1600 for o in objects),
            NrOfTXPDO=sum(0x1800 <= o.index < 0x1A00 for o in objects),
            LSS_Supported=0,
        ),
        _section("DummyUsage", **{f"Dummy{kind:04d}": 0 for kind in range(1, 8)}),
        _section("Comments", Lines=1, Line1="Written by write_eds.py in this folder; change the tables there."),
    ]
    lists: dict[str, list[Object]] = {"MandatoryObjects": [], "OptionalObjects": [], "ManufacturerObjects": []}
    for item in objects:
        maker = "ManufacturerObjects" if 0x2000 <= item.index < 0x6000 else "OptionalObjects"
        lists["MandatoryObjects" if item.index in MANDATORY else maker].append(item)
    for title, items in lists.items():
        listed = {str(place): f"0x{item.index:04X}" for place, item in enumerate(items, 1)}
        sections.append(_section(title, SupportedObjects=len(items), **listed))
        sections.extend(text for item in items for text in _describe(item))
    return "\n".join(sections)


def _describe(item: Object) -> list[str]:
    if item.shape == VARIABLE:
        return [_section(f"{item.index:04X}", **_keys(item.entries[0]))]
    head = _section(
        f"{item.index:04X}", ParameterName=item.name, ObjectType=f"0x{item.shape:X}", SubNumber=len(item.entries)
    )
    return [head, *(_section(f"{item.index:04X}sub{sub:X}", **_keys(entry)) for sub, entry in enumerate(item.entries))]


def _keys(entry: Entry) -> dict[str, object]:
    keys: dict[str, object] = {
        "ParameterName": entry.name,
        "ObjectType": "0x7",
        "DataType": f"0x{entry.kind:04X}",
        "AccessType": entry.access,
        "DefaultValue": "" if entry.access == "wo" else entry.default,
        "PDOMapping": int(entry.pdo),
    }
    for key, bound in (("LowLimit", entry.low), ("HighLimit", entry.high)):
        if bound is not None:
            keys[key] = f"0x{bound % (1 << _BITS[entry.kind]):X}"
    return keys


def _section(title: str, **keys: object) -> str:
    return "\n".join([f"[{title}]", *(f"{key}={value}" for key, value in keys.items()), ""])


def main() -> None:
    """Write the files beside this one."""
    for name in SHEETS:
        (Path(__file__).parent / f"{name}.eds").write_text(sheet(name))


if __name__ == "__main__":
    main()
