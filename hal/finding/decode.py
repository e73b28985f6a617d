"""Description of a CAN frame in words, from object dictionaries, mappings and the explainers of a book.

Source: CiA 301, version 4.2: 7.2.2 (PDO), 7.2.4 (SDO), 7.2.5 (SYNC), 7.2.6 (time), 7.2.7 (EMCY), 7.2.8 (NMT).
"""

import struct
from dataclasses import dataclass

import canopen
from canopen.objectdictionary import ODVariable

from hal.finding.book import EXTENDED, Book, Frame, NamedPdo
from hal.protocols import cia301, cia402, sdo
from hal.protocols.cia301 import NmtCommand, NmtState
from hal.protocols.error_frames import error_frame

TIME = 0x100
_INTEGERS = {2: True, 3: True, 4: True, 0x15: True, 5: False, 6: False, 7: False, 0x1B: False}
"""Integer data types are signed or not."""
_REAL32, _TEXTS = 8, (9, 0xA, 0xB)
_NMT_WORDS = {
    NmtCommand.START: "start",
    NmtCommand.STOP: "stop",
    NmtCommand.PRE_OPERATIONAL: "enter pre-operational",
    NmtCommand.RESET_NODE: "reset",
    NmtCommand.RESET_COMMUNICATION: "reset communication",
}


@dataclass(frozen=True, slots=True)
class FrameText:
    """Description of a frame.

    Attributes:
        kind: `SYNC`, `NMT`, `heartbeat`, `EMCY`, `SDO`, `TPDO1`, ...; `?` if unknown.
        node: Node that sent the frame or receives it, if any.
        text: Content in words.
    """

    kind: str
    node: int | None
    text: str


def describe(frame: Frame, book: Book) -> FrameText:
    """Return the description of a frame, as far as the book has data about the node."""
    if frame.is_error:
        return FrameText("error", None, _error(frame))
    key = frame.identifier | (EXTENDED if frame.is_extended else 0)
    if frame.is_remote:
        return FrameText("remote", None, "asks for the data of this identifier")
    if key in book.explainers:
        kind, explain = book.explainers[key]
        return FrameText(kind, *explain(frame.data))
    if frame.is_extended or frame.is_fd:
        return FrameText("CAN FD" if frame.is_fd else "?", None, "")
    if frame.identifier in book.pdos:
        return _pdo(book.pdos[frame.identifier], frame.data, book)
    return _predefined(frame, book)


def _predefined(frame: Frame, book: Book) -> FrameText:
    """Return the description by the predefined connection set (CiA 301, table 79)."""
    identifier, data = frame.identifier, frame.data
    function, node = identifier & 0x780, identifier & 0x7F
    if identifier == cia301.NMT:
        return _nmt(data)
    if identifier == cia301.SYNC:
        return FrameText("SYNC", None, f"counter {data[0]}" if len(data) == 1 else "")
    if identifier == TIME:
        return FrameText("TIME", None, "")
    if not node:
        return FrameText("?", None, "")
    if function == cia301.EMERGENCY:
        return FrameText("EMCY", node, _emergency(data))
    if function == cia301.HEARTBEAT:
        state = cia301.nmt_state(data)
        return FrameText("heartbeat", node, "malformed" if state is None else nmt_words(state))
    if function in (cia301.SDO_REQUEST, cia301.SDO_ANSWER):
        return FrameText("SDO", node, _sdo(data, function == cia301.SDO_ANSWER, book.dictionaries.get(node)))
    if cia301.TPDO1 <= identifier < cia301.SDO_ANSWER:
        number = (function - cia301.TPDO1) // 0x100 + 1
        label = "RPDO" if function & 0x80 == 0 else "TPDO"
        return FrameText(f"{label}{number}", node, "its mapping is not known")
    return FrameText("?", None, "")


def nmt_words(state: int) -> str:
    """Return an NMT state in words."""
    known = {NmtState.BOOT_UP: "boot-up", NmtState.PRE_OPERATIONAL: "pre-operational"}
    try:
        return known.get(NmtState(state), NmtState(state).name.lower())
    except ValueError:
        return f"unknown state {state:02X}h"


def _nmt(data: bytes) -> FrameText:
    if len(data) != 2:
        return FrameText("NMT", None, "malformed")
    try:
        words = _NMT_WORDS[NmtCommand(data[0])]
    except ValueError:
        words = f"unknown command {data[0]:02X}h"
    return FrameText("NMT", data[1] or None, f"{words}: {f'node {data[1]}' if data[1] else 'all nodes'}")


def _emergency(data: bytes) -> str:
    emergency = cia301.emergency(data)
    if emergency is None:
        return "malformed"
    if not emergency.code:
        return "all errors are gone"
    more = f", detail {emergency.detail.hex(' ').upper()}" if any(emergency.detail) else ""
    return f"{cia301.describe_emergency(emergency.code)}, error register {emergency.register:02X}h{more}"


def _pdo(pdo: NamedPdo, data: bytes, book: Book) -> FrameText:
    size = sum(item.bits for item in pdo.objects)
    if len(data) * 8 < size:
        return FrameText(pdo.label, pdo.node, f"malformed: {len(data)} bytes in place of {(size + 7) // 8}")
    whole, place, parts = int.from_bytes(data, "little"), 0, []
    dictionary = book.dictionaries.get(pdo.node)
    for item in pdo.objects:
        bits = whole >> place & (1 << item.bits) - 1
        place += item.bits
        if item.index > 7:  # lower indices are dummies (CiA 301, 7.4.7)
            entry = _entry(dictionary, item.index, item.subindex)
            raw = bits.to_bytes((item.bits + 7) // 8, "little")
            name = _name(entry) or f"{item.index:04X}h:{item.subindex}"
            parts.append(f"{name} {_value(entry, raw, item.index)}")
    return FrameText(pdo.label, pdo.node, ", ".join(parts))


def _sdo(data: bytes, is_answer: bool, dictionary: canopen.ObjectDictionary | None) -> str:
    if len(data) != 8:
        return "malformed"
    command, index, subindex = sdo.HEAD.unpack_from(data)
    entry = _entry(dictionary, index, subindex)
    name = f"{index:04X}h:{subindex} {_name(entry)}".rstrip()
    kind, is_expedited, is_sized = command >> 5, command & 2, command & 1
    if kind == 4:
        who = "answers" if is_answer else "gives up"
        return f"{who}: abort {name}: {sdo.describe_abort(int.from_bytes(data[4:], 'little'))}"
    if kind == 0:
        part = data[1 : 8 - (command >> 1 & 7)]
        return f"segment {part.hex(' ').upper()} {_printable(part)}".rstrip() + (", the last" if command & 1 else "")
    if is_answer and kind in (1, 3):
        return f"took {name}" if kind == 3 else "took a segment"
    if not is_answer and kind in (2, 3):
        return f"read {name}" if kind == 2 else "next segment"
    if kind in (1, 2):
        verb = "is" if is_answer else "write"
        if not is_expedited:
            size = f" of {int.from_bytes(data[4:], 'little')} bytes" if is_sized else ""
            return f"{verb} {name}: segments{size} follow"
        return f"{verb} {name} = {_value(entry, sdo.expedited(data), index)}"
    return f"block transfer, command {command:02X}h"


def _entry(dictionary: canopen.ObjectDictionary | None, index: int, subindex: int) -> ODVariable | None:
    entry = dictionary.get_variable(index, subindex) if dictionary is not None else None
    return entry if entry is not None and entry.subindex == subindex else None


def _name(entry: ODVariable | None) -> str:
    """Return the name of an object, after the name of its array or record unless it contains that."""
    if entry is None:
        return ""
    parent = getattr(entry.parent, "name", None) or ""
    return str(entry.name) if str(entry.name).startswith(parent) else f"{parent}.{entry.name}"


def _value(entry: ODVariable | None, raw: bytes, index: int) -> str:
    """Return a value as text by its data type; bytes if the type is unknown."""
    kind = entry.data_type if entry is not None else None
    if kind == _REAL32 and len(raw) == 4:
        return f"{struct.unpack('<f', raw)[0]:.7g}"
    if kind in _TEXTS:
        return _printable(raw)
    if kind not in _INTEGERS:
        return f"{raw.hex(' ').upper()}"
    number = int.from_bytes(raw, "little", signed=_INTEGERS[kind])
    if index == cia402.STATUSWORD.index:
        return f"{number:04X}h ({cia402.STATE_OF[number & 0x6F]})"
    if index == cia402.CONTROLWORD.index:
        return f"{number:04X}h"
    is_code = 0x1000 <= index < 0x2000 and len(raw) == 4
    return f"{number:08X}h" if is_code else str(number)


def _printable(raw: bytes) -> str:
    text = raw.rstrip(b"\0").decode("latin-1")
    return f"'{text}'" if text and text.isprintable() else ""


def _error(frame: Frame) -> str:
    error = error_frame(frame.identifier, frame.data)
    counters = f" (errors sending {error.counters[0]}, receiving {error.counters[1]})" if error.counters else ""
    return (error.text or "The controller has recovered.") + counters
