"""What a frame costs by its DBC file and by hand: `python -m studies.bus.dbc [--runs 25]`.

The same frames go through the handler of the DBC driver, through one that is written by hand as those of the other
drivers are, and through cantools' decode with the same conversion behind it, in turn, in one process. CPU time from a
frame's data to its values in SI units; the bar is twice the hand-written path.
"""

import argparse
import gc
import statistics
import struct
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hal.clock import SystemClock
from hal.config import BusConfig
from hal.drivers.can_device import CanDevice, DeviceSettings, Place
from hal.drivers.dbc.sensor import DbcNode
from hal.drivers.dbc.settings import DbcSettings
from hal.protocols import dbc
from hal.wire.bus import Bus

ROBOTS = Path(__file__).parents[2] / "robots"
FRAMES = 20_000
BAR = 2.0

ESTIMATES = DbcSettings(
    dbc=Path("dbc/odrive_cansimple.dbc"),
    node_offset=32,
    periods={"Get_Encoder_Estimates": 0.01},
    quantities={
        "position": {"signal": "Get_Encoder_Estimates.Pos_Estimate", "scale": 0.785},
        "velocity": {"signal": "Get_Encoder_Estimates.Vel_Estimate", "scale": 0.785},
    },
)
FORCE = DbcSettings(
    dbc=Path("dbc/load_cell.dbc"),
    node_offset=1,
    periods={"Force": 0.005},
    quantities={"force": {"signal": "Force.Force"}},
    error={"signal": "Force.Status", "good": "GOOD"},
)


class ByHand(CanDevice):
    """The same two frames as somebody would write them down."""

    _estimates = struct.Struct("<ff")
    _force = struct.Struct("<IB")

    def on_estimates(self, data: bytearray, received: float) -> None:
        """Position and velocity of an axis."""
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
        """Force and status of a cell."""
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
    """Node 3 on a bus that is never opened."""
    bus = Bus("can0", BusConfig(interface="virtual", channel="benchmark"), SystemClock())
    return Place("a", {quantity: f"{quantity}.a" for quantity in quantities}, bus, 3, ROBOTS, 200.0)


def by_cantools(name: str, message: str, signals: dict[str, float]) -> Callable[[bytearray, float], None]:
    """A handler in which cantools decodes, and the values are put where they belong."""
    decode = dbc.load(ROBOTS / "dbc" / name).message(message).decode
    values, times = np.zeros(len(signals)), np.zeros(len(signals))

    def handle(data: bytearray, received: float) -> None:
        found = decode(data, decode_choices=False)
        for slot, (signal, scale) in enumerate(signals.items()):
            values[slot] = scale * found[signal]
            times[slot] = received

    return handle


def microseconds(handle: Callable[[bytearray, float], None], data: bytearray) -> float:
    """CPU time per frame [us]."""
    before = time.thread_time_ns()
    for _ in range(FRAMES):
        handle(data, 1.0)
    return (time.thread_time_ns() - before) / FRAMES / 1e3


def compare(what: str, paths: dict[str, Callable[[bytearray, float], None]], data: bytearray, runs: int) -> float:
    """Measure the paths in turn, print their medians, and return the median ratio of the DBC driver to by hand."""
    found: dict[str, list[float]] = {name: [] for name in paths}
    for _ in range(runs):
        for name, handle in paths.items():
            found[name].append(microseconds(handle, data))
    print(what)
    for name, times in found.items():
        ratio = statistics.median(t / h for t, h in zip(times, found["by hand"], strict=True))
        print(f"  {name:16}{statistics.median(times):6.2f} us   {ratio:5.2f} x by hand")
    return statistics.median(t / h for t, h in zip(found["DBC driver"], found["by hand"], strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", default=25, type=int)
    runs = parser.parse_args().runs
    axis, cell = DbcNode(place("position", "velocity"), ESTIMATES), DbcNode(place("force"), FORCE)
    hand_axis, hand_cell = (
        ByHand(place("position", "velocity"), DeviceSettings()),
        ByHand(place("force"), DeviceSettings()),
    )
    for device in (axis, cell, hand_axis, hand_cell):
        device.is_commissioned = True
    gc.freeze()
    ratios = []
    handler = axis._bus.subscriber(0x069)
    assert handler is not None
    paths = {
        "by hand": hand_axis.on_estimates,
        "DBC driver": handler,
        "cantools": by_cantools(
            "odrive_cansimple.dbc", "Get_Encoder_Estimates", {"Pos_Estimate": 0.785, "Vel_Estimate": 0.785}
        ),
    }
    data = bytearray(struct.pack("<ff", 1.5, -0.25))
    ratios.append(compare("two floats on whole bytes (ODrive estimates)", paths, data, runs))
    handler = cell._bus.subscriber(0x183)
    assert handler is not None
    paths = {
        "by hand": hand_cell.on_force,
        "DBC driver": handler,
        "cantools": by_cantools("load_cell.dbc", "Force", {"Force": 1.0, "Status": 1.0}),
    }
    data = bytearray.fromhex("40 E2 01 00 41")
    ratios.append(compare("24 bits and a nibble of status (load cell)", paths, data, runs))
    assert cell.read().values[0] == hand_cell.read().values[0], "the two paths disagree"
    verdict = "within" if max(ratios) <= BAR else "OVER"
    print(f"{verdict} the bar of {BAR:g}: {max(ratios):.2f}")


if __name__ == "__main__":
    main()
