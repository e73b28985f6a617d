"""Cost of the HAL while it runs, and of the simulated nodes in front of it.

    python -m studies.bus.hal_load [--seconds 300] [ROBOT.yaml]

Without a robot file: ten drives and ten load cells of the muscle-driven arm, five and five on each of two buses, at
200 Hz. The simulated nodes run in another process behind the hub, as in the demo; this process is the HAL alone,
enabled and following a small motion. Both are scheduled as `gemuco hal` and `gemuco simulate` are. Bars: 25 % of a
core, 99.9 % of cycles complete, and 1 ms for a turn of the cycle without the wait for answers. CPU is the process's
own, so other load on the machine only delays; the delay of a bare timer is printed beside.
"""

import argparse
import gc
import multiprocessing
import tempfile
import threading
import time
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
import yaml

from hal import registry
from hal.clock import SystemClock
from hal.config import RobotConfig, load_robot
from hal.errors import CommandRefused
from hal.robot import Robot, open_robot
from hal.wire.budget import budgets
from services.hardware.hal_service import CYCLE_PRIORITY, RECEIVE_PRIORITY
from services.hardware.simulator_service import PRIORITY, THREADS
from services.process import realtime
from studies.stack.processes import BareLoops, cpu

ARM = Path(__file__).parents[2] / "robots" / "musashi_arm.yaml"
RATE = 200.0
WARM_UP = 2.0
"""Time [s] before the measurement."""


class WaitMeter(SystemClock):
    """The machine's clock, which also measures how long the cycle waits for answers."""

    def __init__(self) -> None:
        self.waited = 0.0

    def wait(self, event: threading.Event, deadline: float) -> bool:
        """Wait for an event and add the time."""
        before = time.perf_counter()
        is_set = super().wait(event, deadline)
        self.waited += time.perf_counter() - before
        return is_set


def drives_and_cells() -> RobotConfig:
    """Return ten drives and ten cells of the muscle-driven arm, in front of the bench."""
    raw = yaml.safe_load(ARM.read_text())
    del raw["signals"]["joint_position"], raw["limits"]["joint_position"], raw["collect"], raw["model"]
    raw["devices"] = {name: entry for name, entry in raw["devices"].items() if entry["kind"] != "joint_encoder"}
    raw["simulator"] = "simulators.robots.bench:simulator"
    raw["rates"]["hal"] = RATE
    return RobotConfig.model_validate({**raw, "folder": ARM.parent})


def on_hub(config: RobotConfig, folder: str) -> RobotConfig:
    """Return the robot file with all buses on the hub."""
    buses = {
        name: bus.model_copy(update={"interface": "hub", "channel": f"{folder}/{name}"})
        for name, bus in config.buses.items()
    }
    return config.model_copy(update={"buses": buses})


def simulate(config: RobotConfig, ready: Event, stop: Event) -> None:
    """Run the simulated nodes until `stop`."""
    simulator = registry.load_object(str(config.simulator), "simulator", ("rig",))
    rig = simulator.rig(config, simulator.variants[0], 0)
    realtime.prepare_process()
    rig.start()
    for prefix in THREADS:
        realtime.promote(prefix, PRIORITY)
    realtime.freeze()
    ready.set()
    stop.wait()
    rig.stop()


def follow(robot: Robot, clock: WaitMeter, cycles: int) -> tuple[np.ndarray, dict[str, int]]:
    """Follow a small motion for a number of cycles, on an absolute grid as the service's loop.

    Returns:
        Time of every turn without the wait [s], shape (cycles,); counts of incomplete, skipped and refused turns.
    """
    middle, times, counts = None, np.empty(cycles), {"incomplete": 0, "skipped": 0, "refused": 0}
    due = time.monotonic()
    for number in range(cycles):
        behind = int((time.monotonic() - due) / robot.period)
        if behind > 0:
            counts["skipped"] += behind
            due += behind * robot.period
        due += robot.period
        time.sleep(max(due - time.monotonic(), 0.0))
        clock.waited, begun = 0.0, time.perf_counter()
        sample, applied = robot.cycle()
        times[number] = time.perf_counter() - begun - clock.waited
        counts["incomplete"] += not sample.complete
        if applied.mode == "hold" and middle is None:
            middle = applied.values
        if middle is not None:
            try:
                robot.command(middle + 0.001 * np.sin(0.02 * number), sample.cycle)
            except CommandRefused:  # the machine stood still for longer than a command lives
                counts["refused"] += 1
    return times, counts


def count_frames(robot: Robot) -> int:
    """Return the number of frames received on all buses."""
    return sum(bus["counters"]["received"] for bus in robot.health()["buses"].values())


def run(robot: Robot, clock: WaitMeter, seconds: float) -> None:
    """Run the cycle and print its costs."""
    realtime.prepare_process()
    scheduling = realtime.prepare_thread(CYCLE_PRIORITY)
    realtime.promote("bus ", RECEIVE_PRIORITY)
    until = time.monotonic() + 10.0
    while not robot.cycle()[0].complete and time.monotonic() < until:
        time.sleep(robot.period)
    robot.enable()
    follow(robot, clock, round(WARM_UP / robot.period))
    realtime.freeze()
    cycles, frames = round(seconds / robot.period), count_frames(robot)
    wall, process, thread = time.monotonic(), time.process_time(), time.thread_time()
    times, counts = follow(robot, clock, cycles)
    wall, process, thread = time.monotonic() - wall, time.process_time() - process, time.thread_time() - thread
    frames = count_frames(robot) - frames
    p50, p99 = 1e3 * np.percentile(times, [50, 99])
    print(f"rate           {cycles / wall:.1f} Hz of {1 / robot.period:.0f}; {scheduling}")
    print(f"complete       {1 - counts['incomplete'] / cycles:.3%} of {cycles} cycles (bar 99.9 %); {counts}")
    print(f"whole process  {process / wall:.1%} of a core (bar 25 %), {1e6 * process / cycles:.0f} us per cycle")
    print(
        f"receiving      {1e6 * (process - thread) / frames:.1f} us per frame, {frames / cycles:.1f} frames per cycle"
    )
    print(f"turn, no wait  {p50:.2f} ms median, {p99:.2f} ms p99, {1e3 * times.max():.1f} ms at most")


def main() -> None:
    """Start simulated nodes and a bare timer, and run the HAL."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", nargs="?", type=Path)
    parser.add_argument("--seconds", default=300.0, type=float)
    options = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        config = on_hub(load_robot(options.robot) if options.robot else drives_and_cells(), folder)
        for budget in budgets(config):
            print(f"bus {budget.bus:11}{budget}")
        ready, stop, clock = context.Event(), context.Event(), WaitMeter()
        nodes = context.Process(target=simulate, args=(config, ready, stop))
        nodes.start()
        ready.wait()
        try:
            begun, used = time.monotonic(), cpu(nodes.pid or 0)
            with BareLoops({"bare": (config.rates.hal, CYCLE_PRIORITY)}) as bare, open_robot(config, clock) as robot:
                print(f"commissioning  {time.monotonic() - begun:.2f} s for {len(config.devices)} nodes")
                run(robot, clock, options.seconds)
                share = (cpu(nodes.pid or 0) - used) / (time.monotonic() - begun)
                print(f"simulation     {share:.1%} of a core for nodes, hub and physics")
                for name, bus in robot.health()["buses"].items():
                    print(f"bus {name:11}{bus['counters']}")
                late = bare.counted()["bare"]
                p99, most = 1e3 * late["total_p99"], 1e3 * late["total_max"]
                print(f"bare timer     late by {p99:.2f} ms p99, {most:.1f} ms at most")
        finally:
            gc.unfreeze()
            stop.set()
            nodes.join()


if __name__ == "__main__":
    main()
