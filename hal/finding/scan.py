"""Scan of a bus: first it listens, then it requests the identity of every CANopen node id.

Listening disturbs no node. The requests are SDO reads of identification objects, which change nothing in a node. But an
SDO server has only one client, so no request is sent if a master is active (its SYNC, heartbeat or SDO requests).

Source: CiA 301, version 4.2: 7.5.2 (1000h, 1008h, 1009h, 100Ah, 1018h); ODrive CANSimple (docs.odriverobotics.com):
identifier = node << 5 | command, 01h is the heartbeat; `hal.protocols.mit` for drives in MIT mode (those of Damiao
answer under their id + 16 by default).
"""

import math
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from hal.config import RobotConfig
from hal.finding.book import Frame
from hal.finding.dbc_nodes import DbcDevice, Identifier, dbc_devices
from hal.finding.decode import nmt_words
from hal.finding.tap import Tap
from hal.protocols import cia301, sdo
from hal.protocols.can_frames import CLASSIC, FrameLengths, frame_bits
from hal.protocols.mit import Special, special
from hal.protocols.sdo import Upload
from hal.wire.bus import OWN_NODE

_MIT_SPECIALS = {
    special(Special.ENTER): "enter motor mode",
    special(Special.EXIT): "leave motor mode",
    special(Special.ZERO): "set its position to zero",
}
_MIT_ANSWER = 16
EXTENDED = 1 << 31
"""This flag marks an identifier of 29 bits."""
_BEGINS = (1, 2)
"""An SDO request that begins a transfer has one of these values in its upper three bits."""
_ODRIVE_HEARTBEAT = 1
_ODRIVE_STATES = range(15)
_PROFILES = {
    0: "no profile",
    401: "I/O module",
    402: "servo drive",
    404: "measuring device",
    405: "programmable controller",
    406: "encoder",
    408: "hydraulic drive",
    410: "inclinometer",
    418: "battery",
    419: "charger",
}

_OTHERS = {
    "ODrive": "servo drive (ODrive)",
    "MIT": "servo drive (MIT mode)",
    "DBC": "node of a DBC file",
    "Feetech": "servo (Feetech)",
    "Dynamixel": "servo (Dynamixel)",
}
_SERIAL = ("feetech", "dynamixel")
"""Drivers of servos on a serial line; the protocol of their nodes has the same name."""


@dataclass(slots=True)
class Node:
    """A node that was found.

    Attributes:
        node: Node id.
        protocol: `CANopen`, `ODrive`, `MIT`, `Feetech`, `Dynamixel`, or `DBC` for a node that only the robot file
            knows.
        state: NMT state in words, or other received information.
        objects: (index, sub-index) -> answer, for the objects that the node answered.
        is_doubled: Whether more than one node answers under this id.
    """

    node: int
    protocol: str = "CANopen"
    state: str = ""
    objects: dict[tuple[int, int], bytes] = field(default_factory=dict)
    is_doubled: bool = False

    def number(self, index: int, subindex: int = 0) -> int | None:
        """Return an object that is a number; None without an answer."""
        raw = self.objects.get((index, subindex))
        return None if raw is None else int.from_bytes(raw, "little")

    def text(self, index: int) -> str:
        """Return an object that is a text; empty without an answer."""
        return self.objects.get((index, 0), b"").rstrip(b"\0").decode("latin-1")

    @property
    def profile(self) -> int | None:
        """Number of the device profile, the low word of 1000h; None without an answer."""
        kind = self.number(cia301.DEVICE_TYPE)
        return None if kind is None else kind & 0xFFFF

    @property
    def kind(self) -> str:
        """Kind of device in words."""
        if self.protocol != "CANopen":
            return _OTHERS[self.protocol]
        if self.profile is None:
            return ""
        return f"{_PROFILES.get(self.profile, 'device')} ({self.profile})"


class Traffic:
    """Frames that were received so far, and the nodes that sent them."""

    def __init__(self, devices: Sequence[DbcDevice] = (), lengths: FrameLengths = CLASSIC) -> None:
        self._lengths = lengths
        self._devices = {identifier: device for device in devices for identifier in device.known}
        self._senders = {identifier: device for device in devices for identifier in device.sends}
        self.nodes: dict[tuple[str, int], Node] = {}
        self.named: dict[str, Node] = {}
        """Name in the robot file -> a node with a DBC file."""
        self.counts: Counter[int] = Counter()
        """Identifier -> frames; 29-bit identifiers have `EXTENDED` set."""
        self.bits = 0.0
        self._last: dict[int, bytes] = {}
        self._masters: set[str] = set()
        self.retried: set[int] = set()
        """Nodes with a repeated request, whose second answer does not prove a second node."""

    def note(self, frame: Frame | None) -> None:
        """Add a frame."""
        if frame is None or frame.is_error or frame.is_remote:
            return
        if not self._lengths.fits(len(frame.data), frame.is_fd):
            return
        identifier, data = frame.identifier, frame.data
        self.counts[identifier | (EXTENDED if frame.is_extended else 0)] += 1
        self.bits += self._lengths.of(len(data), frame.is_extended, frame.is_fd)
        if self._note_dbc((identifier, frame.is_extended)) or frame.is_extended or frame.is_fd:
            return
        self._last[identifier] = data
        function, node = identifier & 0x780, identifier & 0x7F
        if identifier == cia301.SYNC and len(data) <= 1:
            self._masters.add("its SYNC")
        elif identifier == cia301.HEARTBEAT + OWN_NODE:
            self._masters.add("a HAL's heartbeat")
        elif function == cia301.HEARTBEAT and node and len(data) == 1:
            self.node("CANopen", node).state = nmt_words(data[0] & 0x7F)
        elif function == cia301.SDO_REQUEST and node and len(data) == sdo.LENGTH and data[0] >> 5 in _BEGINS:
            self._masters.add("its SDO requests")  # own requests are not received
        elif function == cia301.SDO_ANSWER and node and len(data) == sdo.LENGTH:
            self.node("CANopen", node)
        elif data in _MIT_SPECIALS:
            self.node("MIT", identifier).state = f"received the command to {_MIT_SPECIALS[data]}"

    def _note_dbc(self, identifier: Identifier) -> bool:
        """Return whether a frame belongs to a device with a DBC file; the node is heard if it sends this frame."""
        device = self._senders.get(identifier)
        if device is not None:
            node = self.named.setdefault(device.name, Node(device.node, "DBC"))
            name = device.sends[identifier]
            if name not in node.state.removeprefix("sends ").split(", "):
                node.state = f"{node.state}, {name}" if node.state else f"sends {name}"
        return identifier in self._devices

    def barred(self, identifier: int) -> bool:
        """Whether an 11-bit identifier means something to a device with a DBC file, so that nothing may be sent."""
        return (identifier, False) in self._devices

    def node(self, protocol: str, node: int) -> Node:
        """Return the record of a node, which is created at its first frame."""
        return self.nodes.setdefault((protocol, node), Node(node, protocol))

    def odrives(self) -> list[int]:
        """Return the nodes whose frames look like the heartbeat of an ODrive and not like a known CANopen node."""
        likely = []
        for identifier, data in self._last.items():
            is_heartbeat = identifier & 0x1F == _ODRIVE_HEARTBEAT and len(data) == 8 and data[4] in _ODRIVE_STATES
            if is_heartbeat and self.counts[identifier] > 1 and ("CANopen", identifier & 0x7F) not in self.nodes:
                likely.append(identifier >> 5)
        return likely

    def master(self) -> str:
        """Return the reason to assume a master; empty without one."""
        if not self._masters:
            return ""
        return f"A master is active ({', '.join(sorted(self._masters))} was received), so no request was sent."

    def add_odrives(self) -> None:
        """Add the nodes that look like an ODrive."""
        for node in self.odrives():
            self.node("ODrive", node).state = f"axis state {self._last[node << 5 | _ODRIVE_HEARTBEAT][4]}"

    def unexplained(self) -> list[int]:
        """Return the identifiers that do not belong to a node."""
        return sorted(identifier for identifier in self.counts if not self._explained(identifier))

    def _explained(self, identifier: int) -> bool:
        if (identifier & ~EXTENDED, bool(identifier & EXTENDED)) in self._devices:
            return True
        if identifier & EXTENDED:
            return False
        node = identifier & 0x7F
        if identifier in (cia301.NMT, cia301.SYNC, cia301.HEARTBEAT + OWN_NODE):
            return True
        if ("MIT", identifier) in self.nodes or ("MIT", identifier - _MIT_ANSWER) in self.nodes:
            return True
        if ("ODrive", identifier >> 5) in self.nodes:
            return True
        if identifier & 0x780 == cia301.SDO_REQUEST and self._masters:
            return True
        return ("CANopen", node) in self.nodes and identifier >= cia301.EMERGENCY


TRIES = 2
BURST = 4
"""This number of requests is sent at once. A pause of twice their time on the wire follows, because the queue of an
interface may hold only ten frames."""
AFTERWARDS = 0.05
"""The scan waits this time [s] for the answer of a second node with the same id."""
MIT_IDS = range(1, 33)
MIT_ANSWER_TIME = 0.02
_IDENTITY = ((0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4), (0x1008, 0), (0x1009, 0), (0x100A, 0))


@dataclass(slots=True)
class _Dialogue:
    """Requests to one node, one after the other."""

    node: int
    uploads: deque[Upload]
    sent: float = -math.inf
    tries: int = 0


def identify_all(tap: Tap, traffic: Traffic, patience: float) -> None:
    """Find the CANopen nodes that answer, then request their identity."""
    barred = traffic.odrives()  # an SDO request to id n is a command to ODrive 48 + n // 32
    requests = {node: cia301.SDO_REQUEST + node for node in range(1, 128)}
    ids = [node for node, request in requests.items() if request >> 5 not in barred and not traffic.barred(request)]
    _read_all(tap, traffic, {node: [(cia301.DEVICE_TYPE, 0)] for node in ids}, patience)
    answering = [node.node for node in traffic.nodes.values() if node.protocol == "CANopen" and node.objects]
    _read_all(tap, traffic, {node: list(_IDENTITY) for node in answering}, patience)


def _read_all(tap: Tap, traffic: Traffic, keys_of: dict[int, list[tuple[int, int]]], patience: float) -> None:
    """Read objects of many nodes in parallel, one request per node at a time, until a node does not answer."""
    dialogues = {node: _Dialogue(node, deque(Upload(*key) for key in keys)) for node, keys in keys_of.items()}
    pause = max(0.002, 2 * BURST * frame_bits(sdo.LENGTH) / tap.config.bitrate)
    ended = next_burst = time.monotonic()
    while dialogues or time.monotonic() < ended + AFTERWARDS:
        now = time.monotonic()
        if now >= next_burst:
            next_burst = now + pause
            due = [dialogue for dialogue in dialogues.values() if now - dialogue.sent > patience]
            for dialogue in due[:BURST]:
                _send_again(tap, traffic, dialogues, dialogue, now)
        frame = tap.receive(0.002)
        traffic.note(frame)
        if frame is not None and _is_sdo_answer(frame):
            _take_sdo(tap, traffic, dialogues, frame)
        if dialogues:
            ended = now


def _send_again(tap: Tap, traffic: Traffic, dialogues: dict[int, _Dialogue], dialogue: _Dialogue, now: float) -> None:
    """Send a request for the first time, or again after a missing answer."""
    if dialogue.tries == TRIES:
        del dialogues[dialogue.node]
        return
    if dialogue.tries:
        traffic.retried.add(dialogue.node)
    dialogue.sent, dialogue.tries = now, dialogue.tries + 1
    tap.send(cia301.SDO_REQUEST + dialogue.node, dialogue.uploads[0].request)


def _is_sdo_answer(frame: Frame) -> bool:
    is_data = not (frame.is_extended or frame.is_remote or frame.is_error)
    answers = frame.identifier & 0x780 == cia301.SDO_ANSWER and frame.identifier & 0x7F != 0
    return is_data and answers and len(frame.data) == sdo.LENGTH


def _take_sdo(tap: Tap, traffic: Traffic, dialogues: dict[int, _Dialogue], frame: Frame) -> None:
    """Process an SDO answer and send the next request."""
    number = frame.identifier & 0x7F
    node = traffic.node("CANopen", number)
    dialogue = dialogues.get(number)
    if dialogue is None or not dialogue.uploads[0].answer(frame.data):
        command, *key = sdo.HEAD.unpack_from(frame.data)
        is_second = tuple(key) in node.objects and number not in traffic.retried
        node.is_doubled |= command >> 5 == sdo.UPLOAD and is_second
        return
    upload = dialogue.uploads[0]
    if upload.is_done:
        if upload.value is not None:
            node.objects[upload.index, upload.subindex] = upload.value
        dialogue.uploads.popleft()
        if not dialogue.uploads:
            del dialogues[number]
            return
    dialogue.sent, dialogue.tries = time.monotonic(), 1
    tap.send(cia301.SDO_REQUEST + number, dialogue.uploads[0].request)


def find_mit(tap: Tap, traffic: Traffic, patience: float) -> None:
    """End the motor mode of every possible MIT drive; a drive answers with its id in the first byte."""
    before = set(traffic.counts)
    odrives = traffic.odrives()  # an identifier below 33 is a command to ODrive 0 or 1
    requests: list[int] = []
    for node in MIT_IDS:
        if node >> 5 in odrives or traffic.barred(node):
            continue
        tap.send(node, special(Special.EXIT))
        requests.append(node)
        _take_mit(tap, traffic, requests, before, MIT_ANSWER_TIME)
    _take_mit(tap, traffic, requests, before, patience)


def _take_mit(tap: Tap, traffic: Traffic, requests: list[int], before: set[int], duration: float) -> None:
    """Add the drives that answer within `duration` [s]; a late answer may be from any earlier request."""
    deadline = time.monotonic() + duration
    while (remaining := deadline - time.monotonic()) > 0:
        frame = tap.receive(remaining)
        if frame is None or frame.is_extended or frame.is_error or frame.identifier in before:
            continue
        if len(frame.data) not in (6, 7, 8):
            continue
        first = frame.data[0]  # the id, or with Damiao's state above its lower four bits
        likely = [node for node in reversed(requests) if first == node or first & 0x0F == node & 0x0F]
        if likely:
            node = first if first in likely else likely[0]
            traffic.node("MIT", node).state = f"answers on {frame.identifier:03X}h"


LISTEN = 1.5
"""A scan first listens for this time [s]; most nodes send a heartbeat each second or more often."""
ANSWER_TIME = 0.15
"""A node may take this time [s] to answer."""


@dataclass(slots=True)
class Scan:
    """Result of a scan of one bus.

    Attributes:
        bus: Name of the bus.
        nodes: Nodes in the order of their ids.
        unknown: Identifier -> frames per second [Hz], for identifiers that do not belong to a node; those with 29 bits
            have `EXTENDED` set.
        named: Name in the robot file -> node, for the nodes with a DBC file.
        load: Share of the bit rate while listening, 0 to 1.
        silence: Reason why no request was sent; empty if requests were sent.
    """

    bus: str
    nodes: list[Node]
    unknown: dict[int, float]
    load: float
    silence: str
    named: dict[str, Node] = field(default_factory=dict)


def scan(
    tap: Tap,
    listen: float = LISTEN,
    ask: bool = True,
    mit: bool = False,
    patience: float = ANSWER_TIME,
    devices: Sequence[DbcDevice] = (),
) -> Scan:
    """Find the nodes of a bus; takes `listen` and about two seconds.

    Args:
        tap: An open bus.
        listen: Duration of listening at the beginning [s].
        ask: Whether to request the identity of nodes, unless a master is active.
        mit: Whether to find MIT drives by ending their motor mode, which switches the motor off.
        patience: Longest time for an answer [s].
        devices: Devices with a DBC file on this bus; nothing is sent under their identifiers.

    Raises:
        BusGone: The interface failed, or takes no frames.
    """
    traffic = Traffic(devices, FrameLengths(tap.config.bitrate, tap.config.data_bitrate))
    deadline = time.monotonic() + listen
    while (remaining := deadline - time.monotonic()) > 0:
        traffic.note(tap.receive(min(remaining, 0.1)))
    load = traffic.bits / (listen * tap.config.bitrate) if listen else 0.0
    rates = {identifier: count / listen for identifier, count in traffic.counts.items()} if listen else {}
    silence = traffic.master()
    if not ask:
        silence = silence or "Only listened, as requested."
    if not silence:
        identify_all(tap, traffic, patience)
    if mit and not traffic.master():
        find_mit(tap, traffic, patience)
    traffic.add_odrives()
    nodes = sorted(traffic.nodes.values(), key=lambda node: (node.protocol, node.node))
    unknown = {key: rates.get(key, 0.0) for key in traffic.unexplained()}
    nodes += sorted(traffic.named.values(), key=lambda node: node.node)
    return Scan(tap.name, nodes, unknown, load, silence, traffic.named)


def compare(result: Scan, config: RobotConfig) -> list[str]:
    """Return the differences between a bus and the robot file, one sentence each."""
    by_dbc = {device.name: device for device in dbc_devices(config, result.bus)}
    devices = {
        device.node: name for name, device in config.devices.items() if device.bus == result.bus and name not in by_dbc
    }
    nodes = {node.node: node for node in result.nodes if node.protocol != "DBC"}
    differences = [
        f"{result.bus}: node {device.node} ('{name}') was not heard: none of {', '.join(device.sends.values())} came. "
        "Is it powered, is its node id right, is it set to send?"
        for name, device in by_dbc.items()
        if device.sends and name not in result.named
    ]
    for number, name in devices.items():
        place, driver = f"{result.bus}: node {number} ('{name}')", config.kinds[config.devices[name].kind].driver
        if number not in nodes:
            differences.append(f"{place} was not found. Is it powered, is its node id right?")
            continue
        node = nodes[number]
        if driver.startswith("cia") and node.profile is not None and str(node.profile) != driver.removeprefix("cia"):
            differences.append(f"{place} is a {node.kind}, the robot file says {driver}.")
        if driver in _SERIAL and node.protocol.lower() != driver:
            differences.append(f"{place} is a {node.kind}, the robot file says {driver}.")
    for node in nodes.values():
        if node.node not in devices:
            kind = node.kind or "a CANopen node"
            differences.append(f"{result.bus}: node {node.node} is not in the robot file: {kind}.")
        if node.is_doubled:
            differences.append(
                f"{result.bus}: more than one node answers as node {node.node}. Give each an id of its own."
            )
    return differences
