"""Cost of the simulated arm at 200 Hz on the hub, and the time until its answers.

    python -m studies.bus.simulated_nodes [--timed] [--period 0.0025]

With `--timed` the hub keeps the timing of two 1 Mbit/s buses; `--period` is the step of the physics [s].
"""

import argparse
import statistics
import struct
import time
import uuid
from pathlib import Path

import can

from hal.config import BusConfig, load_robot
from simulators import rig as rig_module
from simulators.robots.musashi_arm import simulator

CYCLE = 0.005
ANSWERS = {"can0": 13, "can1": 12}
DRIVES = {"can0": range(1, 6), "can1": range(6, 11)}


def cycle(buses: dict[str, can.BusABC]) -> tuple[float, bool]:
    """Send set-points and SYNC on both buses; return the time [s] to the last answer, and whether all came in time."""
    for name, bus in buses.items():
        while bus.recv(0) is not None:  # a late answer does not belong to this cycle
            pass
        for node in DRIVES[name]:
            data = struct.pack("<Hi", 0x06, 0)
            bus.send(can.Message(arbitration_id=0x200 + node, data=data, is_extended_id=False))
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    start = time.monotonic()
    for name, bus in buses.items():
        missing = ANSWERS[name]
        while missing and (message := bus.recv(max(start + CYCLE - time.monotonic(), 0.0))) is not None:
            missing -= 0x180 < message.arbitration_id < 0x200
        if missing:
            return time.monotonic() - start, False
    return time.monotonic() - start, True


def main() -> None:
    """Run the arm and print its cost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--timed", action="store_true")
    parser.add_argument("--period", type=float, default=rig_module.PERIOD)
    parser.add_argument("--seconds", type=float, default=10.0)
    parsed = parser.parse_args()
    rig_module.PERIOD = parsed.period
    timing = {"bit_timing": True} if parsed.timed else {}
    config = load_robot(Path(__file__).parents[2] / "robots" / "musashi_arm.yaml")
    channels = {
        name: BusConfig(interface="hub", channel=f"bench_{uuid.uuid4().hex[:8]}", options=timing)
        for name in config.buses
    }
    rig = simulator.rig(config.model_copy(update={"buses": channels}), "actual", 1)
    rig.start()
    buses = {name: can.Bus(interface="hub", channel=bus.channel) for name, bus in channels.items()}
    for bus in buses.values():
        bus.send(can.Message(arbitration_id=0, data=[1, 0], is_extended_id=False))
    time.sleep(0.5)
    waits, incomplete = [], 0
    began, spent, own = time.monotonic(), time.process_time(), time.thread_time()
    due = began
    while time.monotonic() < began + parsed.seconds:
        wait, is_complete = cycle(buses)
        waits.append(wait)
        incomplete += not is_complete
        due = max(due + CYCLE, time.monotonic())
        time.sleep(max(due - time.monotonic(), 0.0))
    elapsed = time.monotonic() - began
    share = (time.process_time() - spent - (time.thread_time() - own)) / elapsed
    p99 = statistics.quantiles(waits, n=100)[-1]
    print(f"{share:.0%} of a core for 25 nodes, hub and physics; physics {rig.stats()['physics']}")
    print(f"SYNC to last answer {statistics.median(waits) * 1e3:.2f} ms p50, {p99 * 1e3:.2f} ms p99")
    print(f"{incomplete} of {len(waits)} cycles incomplete after 5 ms")
    for bus in buses.values():
        bus.shutdown()
    rig.stop()


if __name__ == "__main__":
    main()
