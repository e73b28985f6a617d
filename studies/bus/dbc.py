"""CPU time of a frame that is read by its DBC file, and by hand-written code.

    python -m studies.bus.dbc [--runs 25]

The same frames go through the handler of the DBC driver, through one written by hand as those of the other drivers
are, and through cantools' decode with the same conversion behind it, in turn, in one process. Measured is the CPU time
from a frame's data to its values in SI units; the bar is twice the hand-written path.
"""

import argparse
import gc
import statistics
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.drivers.can_device import CanDevice, DeviceSettings, Place
from hal.drivers.dbc.sensor import DbcNode
from hal.drivers.dbc.settings import DbcSettings
from hal.protocols import dbc
from hal.wire.bus import Bus
from studies.bus.frames import microseconds

ROBOTS = Path(__file__).parents[2] / "robots"
FRAMES = 20_000
BAR = 2.0
Handler = Callable[[bytearray, float], None]

ESTIMATES = DbcSettings.model_validate(
    {
        "dbc": "dbc/odrive_cansimple.dbc",
        "node_offset": 32,
        "periods": {"Get_Encoder_Estimates": 0.01},
        "quantities": {
            "position": {"signal": "Get_Encoder_Estimates.Pos_Estimate", "scale": 0.785},
            "velocity": {"signal": "Get_Encoder_Estimates.Vel_Estimate", "scale": 0.785},
        },
    }
)
FORCE = DbcSettings.model_validate(
    {
        "dbc": "dbc/load_cell.dbc",
        "node_offset": 1,
        "periods": {"Force": 0.005},
        "quantities": {"force": {"signal": "Force.Force"}},
        "error": {"signal": "Force.Status", "good": "GOOD"},
    }
)


class ByHand(CanDevice):
    """The same two frames, read by hand-written code."""

    _estimates = struct.Struct("<ff")
    _force = struct.Struct("<IB")

    def on_estimates(self, data: bytearray, received: float) -> None:
        """Read position and velocity of an axis."""
        if len(data) != 8:
            self._counters["malformed"] += 1
            return
        if not self.is_commissioned:
            return
        position, velocity = self._estimates.unpack(data)
        self._values[0] = 0.25 + 0.785 * position
        self._values[1] = 0.785 * velocity
        self._received[0] = received
        self._received[1] = received
        self.missed = 0

    def on_force(self, data: bytearray, received: float) -> None:
        """Read force and status of a cell."""
        if len(data) != 5:
            self._counters["malformed"] += 1
            return
        if not self.is_commissioned:
            return
        bits, _ = self._force.unpack(data)
        force = bits & 0xFFFFFF
        self._status = bits >> 24 & 0xF
        if force & 0x800000:
            force -= 0x1000000
        self._values[0] = 0.001 * force if not self._status else np.nan
        self._received[0] = received
        self.missed = 0


def place(*quantities: str) -> Place:
    """Return node 3 on a bus that is never opened."""
    bus = Bus("can0", BusConfig(interface="virtual", channel="benchmark"), SystemClock())
    return Place("a", {quantity: f"{quantity}.a" for quantity in quantities}, bus, 3, ROBOTS, 200.0)


def by_cantools(name: str, message: str, signals: dict[str, float]) -> Handler:
    """Return a handler in which cantools decodes, and which stores the values and their times."""
    decode: Any = dbc.load(ROBOTS / "dbc" / name).message(message).decode
    values, times = np.zeros(len(signals)), np.zeros(len(signals))

    def handle(data: bytearray, received: float) -> None:
        decoded = decode(data, decode_choices=False)
        for slot, (signal, scale) in enumerate(signals.items()):
            values[slot] = scale * decoded[signal]
            times[slot] = received

    return handle


def compare(what: str, paths: dict[str, Handler], data: bytearray, runs: int) -> float:
    """Measure the paths in turn, print their medians, and return the median ratio of the DBC driver to by hand."""
    times: dict[str, list[float]] = {name: [] for name in paths}
    for _ in range(runs):
        for name, handle in paths.items():

            def job(handle: Handler = handle) -> None:
                for _ in range(FRAMES):
                    handle(data, 1.0)

            times[name].append(microseconds(job, FRAMES))
    ratios = {
        name: statistics.median(t / h for t, h in zip(measured, times["by hand"], strict=True))
        for name, measured in times.items()
    }
    print(what)
    for name, ratio in ratios.items():
        print(f"  {name:16}{statistics.median(times[name]):6.2f} us   {ratio:5.2f} x by hand")
    return ratios["DBC driver"]


def main() -> None:
    """Compare the paths for a frame of whole bytes and for one of 24 bits and a nibble."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", default=25, type=int)
    runs = parser.parse_args().runs
    axis, cell = DbcNode(place("position", "velocity"), ESTIMATES), DbcNode(place("force"), FORCE)
    hand_axis, hand_cell = (ByHand(place(*names), DeviceSettings()) for names in (("position", "velocity"), ("force",)))
    for device in (axis, cell, hand_axis, hand_cell):
        device.is_commissioned = True
    gc.freeze()
    estimates = {"Pos_Estimate": 0.785, "Vel_Estimate": 0.785}
    ratios = [
        compare(
            "two floats on whole bytes (ODrive estimates)",
            {
                "by hand": hand_axis.on_estimates,
                "DBC driver": subscriber(axis, 0x069),
                "cantools": by_cantools("odrive_cansimple.dbc", "Get_Encoder_Estimates", estimates),
            },
            bytearray(struct.pack("<ff", 1.5, -0.25)),
            runs,
        ),
        compare(
            "24 bits and a nibble of status (load cell)",
            {
                "by hand": hand_cell.on_force,
                "DBC driver": subscriber(cell, 0x183),
                "cantools": by_cantools("load_cell.dbc", "Force", {"Force": 1.0, "Status": 1.0}),
            },
            bytearray.fromhex("40 E2 01 00 41"),
            runs,
        ),
    ]
    assert cell.read().values[0] == hand_cell.read().values[0], "the two paths disagree"
    verdict = "within" if max(ratios) <= BAR else "OVER"
    print(f"{verdict} the bar of {BAR:g}: {max(ratios):.2f}")


def subscriber(device: DbcNode, identifier: int) -> Handler:
    """Return the function that receives a frame of the device."""
    handler = device._bus.subscriber(identifier)
    assert handler is not None
    return handler


if __name__ == "__main__":
    main()
