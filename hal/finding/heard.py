"""What one can tell of the nodes of a bus from their frames alone.

Source: ODrive CANSimple (docs.odriverobotics.com): identifier = node << 5 | command, 01h is the heartbeat;
`hal.protocols.mit` for drives in MIT mode, of which those of Damiao answer under their id + 16 as shipped.
"""

from collections import Counter
from dataclasses import dataclass, field

from hal.finding.book import Frame
from hal.finding.decode import nmt_words
from hal.protocols import cia301, sdo
from hal.protocols.mit import Special, special
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
