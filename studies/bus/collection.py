"""Speed of data collection without a bus, in times real time.

    python -m studies.bus.collection [ROBOT ...] [--samples 500]

One condition of each robot of robots/, best of several runs; CPU is process time, so that other load on the machine
does not count. The robot's own share of a cycle is measured beside it, with the world standing still.
"""

import argparse
import time
from pathlib import Path

from hal.config import RobotConfig, load_robot
from hal.robot import Robot
from services.hardware.stand_in import condition_of, simulator_of, variant_of
from services.learning.collector import Request, collect_direct

CYCLES = 2000


def collect(config: RobotConfig, samples: int, repeat: int) -> tuple[float, float, float]:
    """Return robot time, wall time and CPU time [s] of the run that took least CPU."""
    condition = condition_of(config, None)
    runs = []
    for _ in range(repeat):
        cpu = time.process_time()
        result = collect_direct(config, request=Request((condition,) if condition else (), samples))
        runs.append((result.robot_time, result.wall_time, time.process_time() - cpu))
    return min(runs, key=lambda run: run[2] / run[0])


def cost_of_a_cycle(robot: Robot, repeat: int) -> float:
    """Return the CPU time [s] of a cycle that holds a command, without the world's step."""
    with robot:
        sample, _ = robot.cycle()
        robot.enable()
        for _ in range(10):
            sample, applied = robot.cycle()
        best = float("inf")
        for _ in range(repeat):
            begun = time.process_time()
            for _ in range(CYCLES):
                robot.command(applied.values, sample.cycle)
                sample, applied = robot.cycle()
            best = min(best, (time.process_time() - begun) / CYCLES)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", type=Path, default=sorted(Path("robots").glob("*.yaml")))
    parser.add_argument("--samples", type=int, default=500)
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    print(f"{'robot':16} {'cycle Hz':>9} {'x real time':>12} {'by CPU':>8} {'cycle without step':>19}")
    for path in arguments.robots:
        config = load_robot(path)
        robot_time, wall, cpu = collect(config, arguments.samples, arguments.repeat)
        robot = simulator_of(config).direct(config, variant_of(config, None), 0, condition_of(config, None))
        cycle = cost_of_a_cycle(robot, arguments.repeat)
        print(
            f"{config.robot:16} {config.rates.hal:9.0f} {robot_time / wall:12.1f} {robot_time / cpu:8.1f} "
            f"{cycle * 1e6:16.0f} us"
        )


if __name__ == "__main__":
    main()
