"""A CANopen device made of a table of bytes: it knows no profile, and shares no code with drivers and simulated nodes.

It answers expedited SDO from what the test wrote down, says that it is operational when it is started, and sends the
frames that the test gives it.
"""

import contextlib
import threading
import time
from pathlib import Path

import can

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.drivers.can_device import Place
from hal.wire.bus import Bus

ROBOTS = Path(__file__).resolve().parents[2] / "robots"
NODE = 5
ABORT_NO_OBJECT = bytes.fromhex("00 00 02 06")


class Puppet:
    """Node 5 on a virtual bus."""

    def __init__(self, channel, objects):
        """`objects`: "6131:1" -> bytes as they go over the wire, as in "00 00 21 00"."""
        self.objects = {key: bytes.fromhex(value) for key, value in objects.items()}
        self.requests = []
        self._wire = can.Bus(interface="virtual", channel=channel)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def send(self, cob_id, data):
        self._wire.send(can.Message(arbitration_id=cob_id, data=bytes.fromhex(data), is_extended_id=False))

    def close(self):
        self._closing.set()
        self._thread.join()
        self._wire.shutdown()

    def _run(self):
        while not self._closing.is_set():
            frame = self._wire.recv(0.005)
            if frame is None:
                continue
            data = bytes(frame.data)
            if frame.arbitration_id == 0x600 + NODE:
                self.requests.append(data.hex(" ").upper())
                self._reply(0x580 + NODE, self._answer(data))
            elif frame.arbitration_id == 0x000 and data == bytes((0x01, NODE)):
                self._reply(0x700 + NODE, b"\x05")

    def _reply(self, cob_id, data):
        self._wire.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def _answer(self, request):
        place = request[1:4]
        key = f"{place[1]:02X}{place[0]:02X}:{place[2]}"
        if request[0] == 0x40:
            if key not in self.objects:
                return b"\x80" + place + ABORT_NO_OBJECT
            value = self.objects[key]
            return bytes((0x43 | (4 - len(value)) << 2,)) + place + value.ljust(4, b"\0")
        self.objects[key] = request[4 : 8 - (request[0] >> 2 & 3)]
        return b"\x60" + place + bytes(4)


IDENTITY = {"1018:1": "55 4D 45 47", "1018:4": "D2 02 96 49"}


@contextlib.contextmanager
def driven(driver, elements, settings, objects, is_open=True):
    """A driver on a bus with a puppet; both."""
    channel = f"puppet_{id(objects)}_{time.monotonic_ns()}"
    puppet = Puppet(channel, {**IDENTITY, **objects})
    bus = Bus("can0", BusConfig(interface="virtual", channel=channel), SystemClock())
    try:
        device = driver(Place("cell", elements, bus, NODE, ROBOTS, 100.0), driver.Settings.model_validate(settings))
        bus.open()
        if is_open:
            device.open()
        yield device, puppet
    finally:
        bus.close()
        puppet.close()


def report(device, puppet, data, cob_id=0x180 + NODE):
    """What the driver makes of a TPDO, by value."""
    before = device.read().received.copy()
    puppet.send(0x700 + NODE, "05")
    puppet.send(cob_id, data)
    deadline = time.monotonic() + 2.0
    while not (device.read().received > before).any():
        assert time.monotonic() < deadline, "the frame was not taken"
        time.sleep(0.0005)
    time.sleep(0.002)
    return device.read().values.tolist()
