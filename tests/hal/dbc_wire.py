"""Frames of a node with a DBC file on a bus that is never opened."""

import threading
import time

from dbc_file import FILE, SERVO, settings

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.drivers.can_device import Place
from hal.drivers.dbc.servo import DbcServo
from hal.drivers.dbc.settings import DbcSettings, ServoSettings
from hal.wire.bus import Bus

NODE = 2
ANGLE, STATUS, GO = 258 + 4 * NODE, 257 + 4 * NODE, 512 + 4 * NODE
MOTION = 256 + 4 * NODE
OFF, ON, BUSY = "00 00", "01 00", "02 00"
TURN_OFF, TURN_ON = "00 00 00 00 00 00", "01 00 00 00 00 00"
IDENTITY = {"ask": {"frame": {"id": 1}}, "signals": ["Status.Fault", "Status.Mode"]}
DOG = {
    "timeout": 0.1,
    "fed_by": ["Go"],
    "configure": [{"frame": {"id": 3, "data": [7]}}],
    "expired": {"signal": "Status.Fault", "equals": 9},
}
WATCHED = {**SERVO, "watchdog": DOG, "error": {"signal": "Status.Fault"}, "reset": [{"frame": {"id": 5}}]}


class Wire:
    """The frames that a device sends, and the answers to them."""

    def __init__(self, device):
        self.device, self.sent, self.answers = device, [], {}
        device._bus.send = self._send

    def _send(self, frame):
        assert not frame.is_extended_id
        self.sent.append((frame.arbitration_id, frame.data.hex(" ").upper()))
        answer = self.answers.get(self.sent[-1]) or self.answers.get(frame.arbitration_id)
        if answer:
            self.hear(*answer)
        return True

    def hear(self, identifier, data, received=1.0):
        self.device._bus.subscriber(identifier)(bytearray.fromhex(data), received)

    def soon(self, identifier, data, after=0.03):
        """Hear a frame while the device waits."""
        threading.Timer(after, lambda: self.hear(identifier, data, time.monotonic())).start()

    def frames(self):
        sent, self.sent = self.sent, []
        return sent


def open_wire(folder, kind, given, *quantities, node=NODE, **changes):
    """Return the frames of a device whose DBC file is written into a folder."""
    (folder / "node.dbc").write_text(FILE)
    bus = Bus("can0", BusConfig(interface="virtual", channel="dbc_opening"), SystemClock())
    elements = {quantity: f"{quantity}.one" for quantity in quantities or ("position",)}
    place = Place("one", elements, bus, node, folder, 200.0)
    parsed = settings(ServoSettings if kind is DbcServo else DbcSettings, given, **changes)
    return Wire(kind(place, parsed))
