"""CPU time of a received frame, from the bus to SI units.

    python -m studies.bus.frames [--runs 15]

The frames are those of ten simulated drives, ten cells and five encoders (robots/musashi_arm.yaml), recorded while
they run on virtual buses. Then all devices are stopped, and the same frames go repeatedly through the bus, the protocol
and the conversion to SI units, as in the receive thread; beside them, in the same run, through canopen, whose callback
reads the three variables of a drive with `.raw`. The time that python-can takes to hand a frame over comes on top and
is printed for the hub. Bars: 3 us per frame, 8 to 12 us for canopen.
"""

import argparse
import gc
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import can
import canopen
import numpy as np
import yaml

from hal import registry
from hal.clock import SystemClock
from hal.config import RobotConfig
from hal.device import Device
from hal.drivers.can_device import CanDevice
from hal.fleet import build
from hal.robot import Robot
from hal.wire.bus import Bus
from hal.wire.stamps import FrameClock
from simulators.hub import HubServer

ROBOTS = Path(__file__).parents[2] / "robots"
ROUNDS = 30
"""Number of cycles whose frames are handled at once; few, so that their stamps stay fresh."""
RECORD = 1.0
"""Time [s] for which the robot runs."""
DRIVES = range(0x181, 0x18B)
"""Identifiers of the drives' process data."""
WAIT = 0.0003
"""Age [s] of the frames' stamps."""


def microseconds(job: Callable[[], object], frames: int) -> float:
    """Return the CPU time per frame [us] of a job that handles `frames` frames."""
    before = time.thread_time_ns()
    job()
    return (time.thread_time_ns() - before) / frames / 1e3


def report(what: str, times: np.ndarray) -> None:
    """Print the median of times [us], shape (runs,)."""
    print(f"{what:58}{np.median(times):7.2f} us   ({times.min():.2f} to {times.max():.2f} in {len(times)} runs)")


def robot_file() -> RobotConfig:
    """Return the muscle-driven arm on virtual buses; its drives send torque too, as most robots need it."""
    path = ROBOTS / "musashi_arm.yaml"
    raw = yaml.safe_load(path.read_text())
    muscles = raw["signals"]["muscle_length"]["elements"]
    raw["signals"]["muscle_effort"] = {"unit": "N", "elements": muscles}
    for device in raw["devices"].values():
        if device["kind"] == "muscle_drive":
            element = device.pop("element")
            device["elements"] = {"position": element, "effort": element.replace("_length", "_effort")}
    for bus in raw["buses"].values():
        bus["interface"] = "virtual"
    return RobotConfig.model_validate({**raw, "folder": path.parent})


def record(config: RobotConfig) -> tuple[list[Bus], list[Device], dict[str, list[can.Message]]]:
    """Return buses, their commissioned devices, and the newest process data of every node."""
    rig = registry.load_object(str(config.simulator), "simulator", ("rig",)).rig(config, "geometric", 0)
    clock = SystemClock()
    buses, devices = build(config, clock, {})
    robot = Robot(config, devices, buses, clock)
    taps = {name: can.Bus(interface="virtual", channel=bus.channel) for name, bus in config.buses.items()}
    rig.start()
    robot.open()
    until = time.monotonic() + RECORD
    while time.monotonic() < until:
        robot.cycle()
        time.sleep(robot.period)
    recorded: dict[str, list[can.Message]] = {}
    for name, tap in taps.items():
        newest = {}
        while (message := tap.recv(0)) is not None:
            if 0x180 < message.arbitration_id < 0x200:
                newest[message.arbitration_id] = message
        recorded[name] = list(newest.values())
        tap.shutdown()
    rig.stop()
    return [bus for bus in buses if isinstance(bus, Bus)], devices, recorded


def ours(bus: Bus, devices: Sequence[CanDevice], cycle: Sequence[can.Message]) -> float:
    """Return the CPU time per frame [us] of some cycles' frames, as the receive thread handles them."""
    receiver = bus._receiver
    receiver._frame_clock = FrameClock(SystemClock())  # frames have the kernel's stamps
    handle, monotonic = receiver.handle, time.monotonic
    receiver.routes.open_window(monotonic())
    beats = [can.Message(arbitration_id=0x700 + device.node, data=b"\5", is_extended_id=False) for device in devices]
    stamp = time.time() - WAIT
    for message in (*beats, *cycle):
        message.timestamp = stamp
    for message in beats:
        handle(message, monotonic())

    def job() -> None:
        for _ in range(ROUNDS):
            for message in cycle:
                handle(message, monotonic())
            for device in devices:
                device.missed = 1

    cost = microseconds(job, ROUNDS * len(cycle))
    assert all(device.is_commissioned for device in devices), "some frames were not handled"
    return cost


def canopen_raw(frames: Sequence[can.Message]) -> Callable[[], float]:
    """Return a function that measures canopen's CPU time per frame [us] of a drive with three variables."""
    network = canopen.Network()
    node = network.add_node(1, str(ROBOTS / "eds" / "servo_drive.eds"))
    map_ = node.tpdo[1]
    map_.clear()
    for index, bits in ((0x6041, 16), (0x6064, 32), (0x6077, 16)):
        map_.add_variable(index, 0, bits)
    map_.cob_id, map_.enabled = 0x181, True
    network.subscribe(map_.cob_id, map_.on_message)
    seen = []
    map_.add_callback(lambda received: seen.append((received[0].raw, received[1].raw, received[2].raw)))
    batch = [frame.data for frame in frames] * (10 * ROUNDS)

    def job() -> None:
        for data in batch:
            network.notify(0x181, data, 0.0)

    def measure() -> float:
        seen.clear()
        cost = microseconds(job, len(batch))
        assert len(seen) == len(batch)
        return cost

    return measure


def taking_from_hub(count: int = 2000) -> float:
    """Return the CPU time per frame [us] of python-can's `recv`, when frames come one by one as from drives."""
    with tempfile.TemporaryDirectory() as folder, HubServer(f"{folder}/can0"):
        here, there = (can.Bus(interface="hub", channel=f"{folder}/can0") for _ in range(2))

        def send() -> None:
            for _ in range(count):
                there.send(can.Message(arbitration_id=0x181, data=bytes(8), is_extended_id=False))

        sender = threading.Thread(target=send)
        sender.start()
        cost = microseconds(lambda: [here.recv(5.0) for _ in range(count)], count)
        sender.join()
        here.shutdown()
        there.shutdown()
    return cost


def main() -> None:
    """Measure all paths in turn."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", default=15, type=int)
    runs = range(parser.parse_args().runs)
    config = robot_file()
    buses, devices, recorded = record(config)
    bus, cycle = buses[0], recorded[buses[0].name]
    here = {name for name, device in config.devices.items() if device.bus == bus.name}
    answering = [device for device in devices if isinstance(device, CanDevice) and device.name in here]
    drive = [frame for frame in cycle if frame.arbitration_id in DRIVES]
    assert {len(frame.data) for frame in drive} == {8}, "a drive sends statusword, position and torque"
    reference = canopen_raw(drive)
    gc.disable()
    before = dict(bus.counters)
    costs = np.array([(ours(bus, answering, cycle), reference()) for _ in runs])
    gc.enable()
    for count in ("ignored", "unknown", "babbled", "broken_handlers"):
        assert bus.counters[count] == before[count], f"frames were {count}, not handled"
    report("bus, protocol and SI conversion", costs[:, 0])
    report("canopen: notify and a callback that reads three `.raw`", costs[:, 1])
    report("beside either: python-can's recv() from the hub", np.array([taking_from_hub() for _ in runs]))


if __name__ == "__main__":
    main()
