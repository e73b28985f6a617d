"""Finding the nodes of a bus: first by listening, then by asking every CANopen node id for its identity.

Listening disturbs no node. Asking means SDO reads of identification objects, which change nothing in a node; but an SDO
server has one client, so no node is asked while a master is heard (its SYNC, its heartbeat or its own SDO requests).

Source: CiA 301, version 4.2: 7.5.2 (1000h, 1008h, 1009h, 100Ah, 1018h); ODrive CANSimple (docs.odriverobotics.com):
identifier = node << 5 | command, 01h is the heartbeat; `hal.protocols.mit` for drives in MIT mode, of which those of
Damiao answer under their id + 16 as shipped.
"""

import math
import time
from collections import Counter, deque
from dataclasses import dataclass, field

from hal.config import RobotConfig
from hal.finding.book import Frame
from hal.finding.decode import nmt_words
from hal.finding.tap import Tap
from hal.protocols import cia301, sdo
from hal.protocols.mit import Special, special
from hal.protocols.sdo import Upload
from hal.wire.budget import frame_bits
from hal.wire.bus import OWN_NODE

_MIT_SPECIALS = {
    special(Special.ENTER): "enter motor mode",
    special(Special.EXIT): "leave motor mode",
    special(Special.ZERO): "take its place as zero",
}
_MIT_ANSWER = 16
_BEGINS = (1, 2)
"""Upper three bits of an SDO request that begins a transfer."""
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


@dataclass(slots=True)
class Found:
    """A node.

    Attributes:
        node: Its id.
        protocol: `CANopen`, `ODrive` or `MIT`.
        state: NMT state in words, or what else was heard of it.
        objects: (index, sub-index) -> what it answered; only what it did answer.
        is_doubled: More than one node answers as this id.
    """

    node: int
    protocol: str = "CANopen"
    state: str = ""
    objects: dict[tuple[int, int], bytes] = field(default_factory=dict)
    is_doubled: bool = False

    def number(self, index: int, subindex: int = 0) -> int | None:
        """An object that is a number; None if it did not tell."""
        raw = self.objects.get((index, subindex))
        return None if raw is None else int.from_bytes(raw, "little")

    def text(self, index: int) -> str:
        """An object that is a text; empty if it did not tell."""
        return self.objects.get((index, 0), b"").rstrip(b"\0").decode("latin-1")

    @property
    def profile(self) -> int | None:
        """Number of its device profile, the low word of 1000h; None if it did not tell."""
        kind = self.number(cia301.DEVICE_TYPE)
        return None if kind is None else kind & 0xFFFF

    @property
    def kind(self) -> str:
        """What it is, in words."""
        if self.protocol != "CANopen":
            return {"ODrive": "servo drive (ODrive)", "MIT": "servo drive (MIT mode)"}[self.protocol]
        if self.profile is None:
            return ""
        return f"{_PROFILES.get(self.profile, 'device')} ({self.profile})"


class Heard:
    """What was heard so far."""

    def __init__(self) -> None:
        self.nodes: dict[tuple[str, int], Found] = {}
        self.counts: Counter[int] = Counter()
        self.bits = 0
        self._last: dict[int, bytes] = {}
        self._masters: set[str] = set()
        self.retried: set[int] = set()
        """Nodes that were asked twice, so that a second answer means nothing."""

    def note(self, frame: Frame | None) -> None:
        """Take a frame into account."""
        if frame is None or frame.is_error or frame.is_extended or frame.is_remote:
            return
        identifier, data = frame.identifier, frame.data
        self.counts[identifier] += 1
        self.bits += frame_bits(len(data))
        self._last[identifier] = data
        function, node = identifier & 0x780, identifier & 0x7F
        if identifier == cia301.SYNC and len(data) <= 1:
            self._masters.add("its SYNC")
        elif identifier == cia301.HEARTBEAT + OWN_NODE:
            self._masters.add("a HAL's heartbeat")
        elif function == cia301.HEARTBEAT and node and len(data) == 1:
            self.found("CANopen", node).state = nmt_words(data[0] & 0x7F)
        elif function == cia301.SDO_REQUEST and node and len(data) == sdo.LENGTH and data[0] >> 5 in _BEGINS:
            self._masters.add("its SDO requests")  # ours do not come back
        elif function == cia301.SDO_ANSWER and node and len(data) == sdo.LENGTH:
            self.found("CANopen", node)
        elif data in _MIT_SPECIALS:
            self.found("MIT", identifier).state = f"was told to {_MIT_SPECIALS[data]}"

    def found(self, protocol: str, node: int) -> Found:
        """The record of a node, made when it is first heard."""
        return self.nodes.setdefault((protocol, node), Found(node, protocol))

    def odrives(self) -> list[int]:
        """Nodes whose frames look like an ODrive's heartbeat, and like nothing of a CANopen node that is there."""
        likely = []
        for identifier, data in self._last.items():
            is_heartbeat = identifier & 0x1F == _ODRIVE_HEARTBEAT and len(data) == 8 and data[4] in _ODRIVE_STATES
            if is_heartbeat and self.counts[identifier] > 1 and ("CANopen", identifier & 0x7F) not in self.nodes:
                likely.append(identifier >> 5)
        return likely

    def master(self) -> str:
        """Why a master must be there; empty if none was heard."""
        if not self._masters:
            return ""
        return (
            f"A master is at work ({', '.join(sorted(self._masters))} was heard): nobody was asked, to not disturb it."
        )

    def attribute(self) -> None:
        """Tell who the frames that are not CANopen come from."""
        for node in self.odrives():
            self.found("ODrive", node).state = f"axis state {self._last[node << 5 | _ODRIVE_HEARTBEAT][4]}"

    def unexplained(self) -> list[int]:
        """Identifiers that belong to none of the nodes."""
        return sorted(identifier for identifier in self.counts if not self._explained(identifier))

    def _explained(self, identifier: int) -> bool:
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
"""Requests in one go, and then a pause of twice their time on the wire: an interface's queue may have ten places."""
AFTERWARDS = 0.05
"""How long to wait [s] for the answer of a second node with the same id."""
MIT_IDS = range(1, 33)
MIT_ANSWER_TIME = 0.02
_IDENTITY = ((0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4), (0x1008, 0), (0x1009, 0), (0x100A, 0))


@dataclass(slots=True)
class _Talk:
    """Questions to one node, one after the other."""

    node: int
    uploads: deque[Upload]
    sent: float = -math.inf
    tries: int = 0


def ask_all(tap: Tap, heard: Heard, patience: float) -> None:
    """First who is there, then who it is."""
    barred = heard.odrives()  # an SDO request to id n is a command to ODrive 48 + n // 32
    ids = [node for node in range(1, 128) if (cia301.SDO_REQUEST + node) >> 5 not in barred]
    _converse(tap, heard, {node: [(cia301.DEVICE_TYPE, 0)] for node in ids}, patience)
    there = [found.node for found in heard.nodes.values() if found.protocol == "CANopen" and found.objects]
    _converse(tap, heard, {node: list(_IDENTITY) for node in there}, patience)


def _converse(tap: Tap, heard: Heard, questions: dict[int, list[tuple[int, int]]], patience: float) -> None:
    """Ask many nodes at the same time, each one question at a time; whoever does not answer is asked no more."""
    talks = {node: _Talk(node, deque(Upload(*key) for key in keys)) for node, keys in questions.items()}
    pause = max(0.002, 2 * BURST * frame_bits(sdo.LENGTH) / tap.config.bitrate)
    ended = next_burst = time.monotonic()
    while talks or time.monotonic() < ended + AFTERWARDS:
        now = time.monotonic()
        if now >= next_burst:
            next_burst = now + pause
            due = [talk for talk in talks.values() if now - talk.sent > patience]
            for talk in due[:BURST]:
                _ask_again(tap, heard, talks, talk, now)
        frame = tap.receive(0.002)
        heard.note(frame)
        if frame is not None and _is_sdo_answer(frame):
            _take(tap, heard, talks, frame)
        if talks:
            ended = now


def _ask_again(tap: Tap, heard: Heard, talks: dict[int, _Talk], talk: _Talk, now: float) -> None:
    """A question that was not asked yet, or not answered in time."""
    if talk.tries == TRIES:
        del talks[talk.node]
        return
    if talk.tries:
        heard.retried.add(talk.node)
    talk.sent, talk.tries = now, talk.tries + 1
    tap.send(cia301.SDO_REQUEST + talk.node, talk.uploads[0].request)


def _is_sdo_answer(frame: Frame) -> bool:
    is_data = not (frame.is_extended or frame.is_remote or frame.is_error)
    answers = frame.identifier & 0x780 == cia301.SDO_ANSWER and frame.identifier & 0x7F != 0
    return is_data and answers and len(frame.data) == sdo.LENGTH


def _take(tap: Tap, heard: Heard, talks: dict[int, _Talk], frame: Frame) -> None:
    """An SDO answer has come."""
    node = frame.identifier & 0x7F
    found = heard.found("CANopen", node)
    talk = talks.get(node)
    if talk is None or not talk.uploads[0].answer(frame.data):
        command, *key = sdo.HEAD.unpack_from(frame.data)
        found.is_doubled |= command >> 5 == sdo.UPLOAD and tuple(key) in found.objects and node not in heard.retried
        return
    upload = talk.uploads[0]
    if upload.is_done:
        if upload.value is not None:
            found.objects[upload.index, upload.subindex] = upload.value
        talk.uploads.popleft()
        if not talk.uploads:
            del talks[node]
            return
    talk.sent, talk.tries = time.monotonic(), 1
    tap.send(cia301.SDO_REQUEST + node, talk.uploads[0].request)


def look_for_mit(tap: Tap, heard: Heard, patience: float) -> None:
    """End the motor mode of every possible MIT drive; one that is there answers with its id in the first byte."""
    before = set(heard.counts)
    odrives = heard.odrives()  # an identifier below 33 is a command to ODrive 0 or 1
    asked: list[int] = []
    for node in MIT_IDS:
        if node >> 5 in odrives:
            continue
        tap.send(node, special(Special.EXIT))
        asked.append(node)
        _take_mit(tap, heard, asked, before, MIT_ANSWER_TIME)
    _take_mit(tap, heard, asked, before, patience)


def _take_mit(tap: Tap, heard: Heard, asked: list[int], before: set[int], duration: float) -> None:
    """Whose answers come within `duration` [s]; a late one may be of any drive that was asked."""
    deadline = time.monotonic() + duration
    while (remaining := deadline - time.monotonic()) > 0:
        frame = tap.receive(remaining)
        if frame is None or frame.is_extended or frame.is_error or frame.identifier in before:
            continue
        if len(frame.data) not in (6, 7, 8):
            continue
        first = frame.data[0]  # the id, or with Damiao's state above its lower four bits
        likely = [node for node in reversed(asked) if first == node or first & 0x0F == node & 0x0F]
        if likely:
            node = first if first in likely else likely[0]
            heard.found("MIT", node).state = f"answers on {frame.identifier:03X}h"


LISTEN = 1.5
"""How long to listen first [s]; most nodes send a heartbeat each second or more often."""
ANSWER_TIME = 0.15
"""How long a node may take to answer [s]."""


@dataclass(slots=True)
class Scan:
    """What was found on one bus.

    Attributes:
        bus: Its name.
        nodes: In the order of their ids.
        unknown: Identifier -> frames per second [Hz], of all that no known node explains.
        load: Share of the bit rate while listening, 0 to 1.
        silence: Why nobody was asked; empty if everybody was.
    """

    bus: str
    nodes: list[Found]
    unknown: dict[int, float]
    load: float
    silence: str


def scan(tap: Tap, listen: float = LISTEN, ask: bool = True, mit: bool = False, patience: float = ANSWER_TIME) -> Scan:
    """Find out who is on a bus; takes `listen` and about two seconds.

    Args:
        tap: An open bus.
        listen: How long to listen first [s].
        ask: Whether to ask nodes who they are, unless a master is heard.
        mit: Whether to look for MIT drives by ending their motor mode, which lets go of the joint.
        patience: How long a node may take to answer [s].

    Raises:
        BusGone: The interface failed, or takes no frames.
    """
    heard = Heard()
    deadline = time.monotonic() + listen
    while (remaining := deadline - time.monotonic()) > 0:
        heard.note(tap.receive(min(remaining, 0.1)))
    load = heard.bits / (listen * tap.config.bitrate) if listen else 0.0
    rates = {identifier: count / listen for identifier, count in heard.counts.items()} if listen else {}
    silence = heard.master()
    if not ask:
        silence = silence or "Only listened, as asked."
    if not silence:
        ask_all(tap, heard, patience)
    if mit and not heard.master():
        look_for_mit(tap, heard, patience)
    heard.attribute()
    nodes = sorted(heard.nodes.values(), key=lambda found: (found.protocol, found.node))
    return Scan(tap.name, nodes, {key: rates.get(key, 0.0) for key in heard.unexplained()}, load, silence)


def compare(found: Scan, config: RobotConfig) -> list[str]:
    """What of a bus is not as the robot file says, a sentence each."""
    wanted = {device.node: name for name, device in config.devices.items() if device.bus == found.bus}
    drivers = {node: config.kinds[config.devices[name].kind].driver for node, name in wanted.items()}
    told = []
    there = {one.node: one for one in found.nodes}
    for node, name in wanted.items():
        if node not in there:
            told.append(f"{found.bus}: node {node} ('{name}') was not found. Is it powered, is its node id right?")
            continue
        profile = drivers[node].removeprefix("cia")
        one = there[node]
        if drivers[node].startswith("cia") and one.profile is not None and str(one.profile) != profile:
            told.append(f"{found.bus}: node {node} ('{name}') is a {one.kind}, the robot file says {drivers[node]}.")
    for one in found.nodes:
        if one.node not in wanted:
            told.append(f"{found.bus}: node {one.node} is not in the robot file: {one.kind or 'a CANopen node'}.")
        if one.is_doubled:
            told.append(f"{found.bus}: more than one node answers as node {one.node}. Give each an id of its own.")
    return told
