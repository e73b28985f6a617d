"""Random motion of every variant of the Musashi-like arm: how safe, how far from the designer's model, how fast.

    python -m benchmarks.arm_variants [--minutes 10] [--seeds 5]

Runs the direct backend under the real Robot cycle, one line per arm. Speed is simulated time over process time.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from hal.config import RobotConfig, load_robot
from simulators.robots.musashi_arm import random_motion, simulator
from simulators.robots.musashi_arm.model import chain, designed_elastic, designed_paths
from simulators.robots.musashi_arm.motion import SETTLE

ROBOT = Path(__file__).parents[1] / "robots" / "musashi_arm.yaml"


def wanted_position(length: np.ndarray, tension: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Joint positions [rad] at which the designer's model has wires of `length` [m] under `tension` [N]."""
    path = length + designed_elastic().elongation(np.maximum(tension, 0.0))
    position = near
    for _ in range(20):
        at, arms = designed_paths().solve(position)
        position = np.clip(position + np.linalg.lstsq(arms, path - at, rcond=None)[0], chain().low, chain().high)
    return position


def run(config: RobotConfig, variant: str, seed: int, minutes: float) -> str:
    """Move one arm at random; one line of what was measured."""
    robot = simulator.direct(config, variant, seed)
    motion = random_motion(config, seed)
    limits = config.limits["muscle_tension"]
    missed, peak, beyond, worst = [], 0.0, 0, 0.0
    begun = time.process_time()
    with robot:
        sample, _ = robot.cycle()
        robot.enable()
        tick, rest, command, is_rest = robot.clock.monotonic(), 0.0, None, False
        for _ in range(round(minutes * 60.0 / robot.period)):
            if rest < 1e-9:
                if is_rest:
                    tension, position = sample.values["muscle_tension"], sample.values["joint_position"]
                    model = wanted_position(sample.values["muscle_length"], tension, position)
                    missed.append(np.linalg.norm(model - position))
                command, duration = next(motion)
                rest, is_rest = rest + duration, duration == SETTLE
            tick, rest = tick + robot.period, rest - robot.period
            robot.clock.sleep_until(tick)
            sample, _ = robot.cycle()
            if robot.mode in ("hold", "follow"):
                robot.command(command, sample.cycle)
            elif robot.mode == "fault":
                return f"{variant:10} {seed:4}  {robot.fault_text}"
            position, tension = sample.values["joint_position"], sample.values["muscle_tension"]
            peak = max(peak, tension.max())
            beyond += bool(tension.max() > (limits.soft_high or np.inf))
            worst = max(worst, (chain().low - position).max(), (position - chain().high).max())
    speed = minutes * 60.0 / (time.process_time() - begun)
    return (
        f"{variant:10} {seed:4} {len(missed):9} {np.mean(missed):12.3f} {np.percentile(missed, 95):8.3f} {peak:9.0f}"
        f" {100 * beyond / sample.cycle:9.2f} {worst:10.3f} {speed:9.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="simulated minutes per arm")
    parser.add_argument("--seeds", type=int, default=5, help="how many seeds of each variant")
    arguments = parser.parse_args()
    config = load_robot(ROBOT)
    print(
        "variant    seed  postures  model [rad]      p95  peak [N]  soft [%]  stop [rad]  x real time\n"
        "                           (difference between the posture and the one the geometric model reads from"
        " length and tension)"
    )
    for variant in simulator.variants:
        for seed in range(arguments.seeds):
            print(run(config, variant, seed, arguments.minutes), flush=True)


if __name__ == "__main__":
    main()
