"""A drive in MIT mode on a bus that is never opened: the frames that it gets, and a device that answers them."""

import itertools
import struct

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.drivers.can_device import Place
from hal.drivers.mit.drive import MitDrive
from hal.wire.bus import Bus

DAMIAO = {"motor": "DM4310", "stiffness": 40.0, "damping": 2.0, "ramp": 0.0}
T_MOTOR = {"motor": "AK80-9", "stiffness": 40.0, "damping": 2.0, "ramp": 0.0, "allow_no_watchdog": True}
QUANTITIES = ("position", "velocity", "effort", "temperature", "temperature_driver")
REST = "7F FF 7F F0 00 00 07 FF"
BRAKE = "7F FF 7F F0 00 66 67 FF"
"""Damping 2 of 5 N m s/rad: 1638 of 4095, 666h."""
CLEAR, ENTER, EXIT = (f"FF FF FF FF FF FF FF {code}" for code in ("FB", "FC", "FD"))
ENABLED, DISABLED, TOO_HOT = 0x10, 0x00, 0xC0
"""State in the upper four bits of a Damiao answer."""
REGISTERS = {
    9: (3000).to_bytes(4, "little"),  # 0.15 s in units of 50 us
    10: (1).to_bytes(4, "little"),
    15: bytes.fromhex("78 56 34 12"),
    21: struct.pack("<f", 12.5),
    22: struct.pack("<f", 30.0),
    23: struct.pack("<f", 10.0),
}
_numbers = itertools.count()


class Wire:
    """A drive on a bus that is never opened, the frames that it gets, and a device that answers them."""

    def __init__(self, settings=DAMIAO, node=1, bus=None, quantities=None, rate=200.0, **changes):
        self.bus = bus or Bus(
            f"can{next(_numbers)}", BusConfig(interface="virtual", channel="mit_frames"), SystemClock()
        )
        parsed = MitDrive.Settings.model_validate({**settings, **changes})
        count = 5 if settings["motor"].startswith("DM") else 4
        elements = {name: f"{name}.elbow" for name in quantities or QUANTITIES[:count]}
        place = Place("elbow", elements, self.bus, node, None, rate, bounds=(-1.0, 1.0))
        self.device = MitDrive(place, parsed)
        self.sent, self.state, self.answers_after = [], DISABLED, 1
        self.registers = dict(REGISTERS)
        self.bus.send = self._send

    def _send(self, frame):
        assert not frame.is_extended_id
        data = bytes(frame.data)
        self.sent.append(data.hex(" ").upper() if frame.arbitration_id != 0x7FF else data)
        if frame.arbitration_id == 0x7FF:
            if data[3] in self.registers:
                if data[2] == 0x55:
                    self.registers[data[3]] = data[4:]
                self.hear(data[:4] + self.registers[data[3]])
        elif len(self.sent) >= self.answers_after:
            self.answer()
        return True

    def hear(self, data, received=1.0):
        self.bus.subscriber(self.device._reply_id)(bytearray(data), received)

    def answer(self, position=0x7FFF, velocity=0x7FF, effort=0x7FF, last=None, received=1.0):
        last = last or ((0x41, 0x00) if self.device._registers is None else (0x28, 0x1E))
        bits = (position << 24 | velocity << 12 | effort).to_bytes(5, "big")
        first = self.device.node & 0xFF if self.device._registers is None else self.state | self.device.node & 0x0F
        self.hear(bytes((first,)) + bits + bytes(last), received)

    def frames(self):
        sent, self.sent = self.sent, []
        return sent

    def ready(self):
        """Commissioned and heard, without power."""
        self.device.is_commissioned, self.device.missed = True, 0
        self.device._is_closed = False
        self.answer()
        return self
