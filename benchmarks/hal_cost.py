"""What the HAL costs: `python -m benchmarks.hal_cost [robots/musashi_arm.yaml] [--cycles 2000]`.

The simulated nodes run in another process behind the hub, as in the demo; this process is the HAL alone. CPU is process
time, so that other load on the machine does not count.
"""

import argparse
import gc
import multiprocessing
import tempfile
import time
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

from hal import registry
from hal.budget import budgets
from hal.config import RobotConfig, load_robot
from hal.robot import Robot, open_robot


def simulate(config: RobotConfig, ready: Event, stop: Event) -> None:
    rig = registry.load(str(config.simulator)).rig(config, "geometric", 0)
    rig.start()
    ready.set()
    stop.wait()
    rig.stop()


def on_hub(config: RobotConfig, folder: str) -> RobotConfig:
    buses = {
        name: bus.model_copy(update={"interface": "hub", "channel": f"{folder}/{name}"})
        for name, bus in config.buses.items()
    }
    return config.model_copy(update={"buses": buses})


def run(robot: Robot, cycles: int) -> None:
    """Follow a small motion for so many cycles and print what they cost."""
    while not robot.cycle()[0].complete:
        time.sleep(robot.period)
    robot.enable()
    turns, incomplete, middle = [], 0, None
    received = sum(bus["counters"]["received"] for bus in robot.health()["buses"].values())
    gc.freeze()
    wall, process, thread = time.monotonic(), time.process_time(), time.thread_time()
    due = wall
    for number in range(cycles):
        due = max(due + robot.period, time.monotonic())
        time.sleep(max(due - time.monotonic(), 0.0))
        before = time.perf_counter()
        sample, applied = robot.cycle()
        turns.append(time.perf_counter() - before)
        incomplete += not sample.complete
        if applied.mode == "hold" and middle is None:
            middle = applied.values
        if middle is not None:
            robot.command(middle + 0.001 * np.sin(0.02 * number), sample.cycle)
    wall, process, thread = time.monotonic() - wall, time.process_time() - process, time.thread_time() - thread
    received = sum(bus["counters"]["received"] for bus in robot.health()["buses"].values()) - received
    print(f"rate           {cycles / wall:.1f} Hz of {1 / robot.period:.0f}, {incomplete / cycles:.2%} incomplete")
    print(f"whole process  {process / wall:.1%} of a core, {process / cycles * 1e6:.0f} us per cycle")
    print(f"cycle thread   {thread / cycles * 1e6:.0f} us per cycle")
    print(f"receiving      {(process - thread) / received * 1e6:.1f} us per frame, {received / cycles:.1f} per cycle")
    p50, p99 = np.percentile(turns, [50, 99]) * 1e3
    print(f"a turn         {p50:.2f} ms p50, {p99:.2f} ms p99, from set-points to sample")


def direct(config: RobotConfig, cycles: int) -> None:
    """The same cycle without a bus, as data collection turns it; the physics stands still."""
    with registry.load(str(config.simulator)).direct(config, "geometric", 0) as robot:
        robot.cycle()
        robot.enable()
        sample, applied = robot.cycle()
        before = time.process_time()
        for _ in range(cycles):
            sample, _ = robot.cycle()
            robot.command(applied.values, sample.cycle)
        print(f"without a bus  {(time.process_time() - before) / cycles * 1e6:.0f} us per cycle and command")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robot", nargs="?", default="robots/musashi_arm.yaml", type=Path)
    parser.add_argument("--cycles", default=2000, type=int)
    given = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        config = on_hub(load_robot(given.robot), folder)
        for budget in budgets(config):
            print(f"bus {budget.bus:11}{budget}")
        ready, stop = context.Event(), context.Event()
        nodes = context.Process(target=simulate, args=(config, ready, stop))
        nodes.start()
        ready.wait()
        try:
            before = time.monotonic()
            with open_robot(config) as robot:
                print(f"commissioning  {time.monotonic() - before:.2f} s for {len(config.devices)} nodes")
                run(robot, given.cycles)
        finally:
            stop.set()
            nodes.join()
        direct(config, given.cycles)


if __name__ == "__main__":
    main()
